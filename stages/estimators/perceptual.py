"""The networks of the perceptual loss."""

from __future__ import annotations

import numpy as np

from stages.avatar.measures.lpips import Lpips
from stages.estimators.assets import fetch


def network(name: str, device: str) -> Lpips:
    """LPIPS by the network `name`, "alex" or "vgg", on a device; its weights are fetched where they are not here."""
    with np.load(fetch(f"lpips_{name}.npz")) as arrays:
        return Lpips(arrays).to(device)

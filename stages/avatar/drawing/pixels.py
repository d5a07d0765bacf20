"""Pictures as they leave the program."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch

Pixels = TypeVar("Pixels", np.ndarray, torch.Tensor)


def exposed(image: Pixels, alpha: Pixels, ground: Pixels | float, gain: Pixels) -> Pixels:
    """Colours [H,W,3] of an `image` over a `ground`, covered by `alpha` [H,W]; `gain` [3] is of all but the ground."""
    bare = (1 - alpha)[..., None] * ground
    return bare + gain * (image - bare)


def cut_out(image: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """A picture [H,W,3] over black, covered by `alpha` [H,W], as bytes [H,W,4] whose alpha is not multiplied into colour."""
    color = image / np.maximum(alpha, 1 / 255)[..., None]
    return to_uint8(np.concatenate([color, alpha[..., None]], 2))


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Values in 0..1 as bytes, clipped and rounded; raises ValueError when one is not finite."""
    if not np.isfinite(image).all():
        raise ValueError(f"{(~np.isfinite(image)).sum()} values of a picture are not finite")
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)

"""The optional arrays `clothes_...` of avatar.npz: how loose clothes move with the pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stages.formats.arrays import checked, take
from stages.records import Clothes


def clothes_of(arrays: Mapping[str, np.ndarray], name: str, hint: str) -> Clothes | None:
    """The clothes in the arrays of the file `name`, None without them; StageError for missing ones and wrong shapes."""
    found = {key.removeprefix("clothes_"): value for key, value in arrays.items() if key.startswith("clothes_")}
    if not found:
        return None
    nodes = checked(take(found, "nodes", name, hint), (None, 3), "nodes", name, hint)
    low = checked(take(found, "low", name, hint), (None,), "low", name, hint)
    shapes = {"mean": (69,), "axes": (69, len(low)), "high": low.shape, "offsets": (*nodes.shape, len(low))}
    rest = {key: checked(take(found, key, name, hint), shape, key, name, hint) for key, shape in shapes.items()}
    return Clothes(nodes=nodes, low=low, **rest)

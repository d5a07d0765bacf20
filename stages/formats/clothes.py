"""The optional arrays `clothes_...` of avatar.npz: the bones of clothes, and how they swing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stages.formats.arrays import checked, read_npz, take
from stages.formats.budget import check_count
from stages.records import JOINTS, Clothes

OLD = "nodes"
"""An array that only clothes of files of version 1 have: they moved points of the body by offsets, without bones."""


def has_old_clothes(path: Path) -> bool:
    """Whether the clothes of an avatar.npz moved without bones, as of version 1; such are read without them."""
    return bool(read_npz(path, only=[f"clothes_{OLD}"]))


def clothes_of(arrays: Mapping[str, np.ndarray], name: str, hint: str) -> Clothes | None:
    """The clothes in the arrays of the file `name`, None without them; StageError for missing ones and wrong shapes.

    None, too, for clothes of version 1, see `has_old_clothes`: they follow the skin.
    """
    found = {key.removeprefix("clothes_"): value for key, value in arrays.items() if key.startswith("clothes_")}
    if not found or OLD in found:
        return None
    count = len(checked(take(found, "centres", name, hint), (None, 3), "centres", name, hint))
    check_count(count, "bones of clothes", name, hint)
    features = len(checked(take(found, "low", name, hint), (None,), "low", name, hint))
    shapes = {
        "swings": (count, 6, 1 + features),
        "centres": (count, 3),
        "carriers": (count, JOINTS),
        "mean": (3 * (JOINTS - 1),),
        "axes": (3 * (JOINTS - 1), features),
        "low": (features,),
        "high": (features,),
    }
    return Clothes(**{key: checked(take(found, key, name, hint), shapes[key], key, name, hint) for key in shapes})

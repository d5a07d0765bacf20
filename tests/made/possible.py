"""Numbers that can be: what stages print and write is finite, and within what pictures, angles and shares can have."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

PIXELS = ("reprojection_px", "error_px", "epipolar_px", "displacement_px", "max_shift_px", "residual_px")


def numbers(tree: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Every number in a JSON tree, with the key that it stands under."""
    if isinstance(tree, dict):
        for key, branch in tree.items():
            yield from numbers(branch, key)
    elif isinstance(tree, list | tuple):
        for branch in tree:
            yield from numbers(branch, name)
    elif isinstance(tree, int | float):
        yield name, tree


def impossible(tree: Any, width: int, height: int) -> list[str]:
    """Numbers of a stage's JSON that cannot be, for pictures of that size."""
    found = []
    for name, value in numbers(tree):
        fine = math.isfinite(value)
        if name.endswith(PIXELS):
            fine = 0 <= value <= math.hypot(width, height)
        elif name.endswith(("_deg", "_degrees")):
            fine = 0 <= value <= 180
        elif name in ("iou", "mean_iou", "confidence", "stays", "flatness", "walk_behind"):
            fine = 0 <= value <= 1
        if not fine:
            found.append(f"{name}: {value}")
    return found

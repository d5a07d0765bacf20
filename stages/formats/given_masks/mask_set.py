"""The record that every reader of given masks returns: names, objects, and how to read each mask."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stages.contract import StageError
from stages.formats.frame_names import extracting

Values = tuple[np.ndarray, str]
"""A mask's values [H,W] as stored, and the name of the encoding."""


@dataclass(frozen=True)
class MaskSet:
    """`names` of the masks without endings; None: the i-th belongs to the video's i-th frame.

    `objects` are the ids that the file keeps apart, ("",) if none. `read(object, i)` gives the values of that object in
    the i-th mask, None where the object is not in that frame.
    """

    kind: str
    names: tuple[str, ...] | None
    objects: tuple[str, ...]
    read: Callable[[str, int], Values | None]


def check_one_per_frame(count: int, frames: range, what: str, film: str) -> None:
    """StageError unless masks without names are as many as the video's frames; `frames`: how many these can be."""
    if count not in frames:
        hint = f"without names they belong to frames by their order: {extracting(film)}"
        raise StageError(f"{what} does not have a mask for each frame", hint, [f"{count} masks, {frames[-1]} frames"])

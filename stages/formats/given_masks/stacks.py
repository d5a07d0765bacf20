"""Stacks of masks in .npy and .npz files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import BROKEN, read_npz, texts
from stages.formats.budget import STACK
from stages.formats.frame_names import stem
from stages.formats.given_masks.mask_set import MaskSet, Values, check_one_per_frame
from stages.formats.given_masks.values import checked_values

HINT = "a stack is one array [N,H,W], with `names` [N] or as many masks as the video has frames; or an array a frame"
NAMES = ("names", "frame_names", "file_names", "filenames", "frames", "frame_ids", "frame_idx", "indices")


def read_stack(path: Path, frames: range, film: str) -> MaskSet:
    """Read a .npy with a stack, or a .npz with a stack and names, or with one array named after each frame.

    Raises StageError for pickled or damaged files, other shapes, more or fewer names than masks, and a stack
    without names that has not a mask for each of the video's frames; `frames`: how many these can be.
    """
    if path.suffix.lower() == ".npy":
        try:
            arrays = {"array": np.load(path, mmap_mode="r", allow_pickle=False)}
        except BROKEN as error:
            raise StageError(f"{path} is not a plain .npy array", "save it by numpy.save", [str(error)]) from error
    else:
        arrays = read_npz(path, HINT, most=STACK)
    stacks = {key: stack for key, array in arrays.items() if (stack := as_stack(array)) is not None}
    if len(stacks) == 1:
        return one_stack(path, *next(iter(stacks.items())), arrays, frames, film)
    single = {key: np.squeeze(array) for key, array in arrays.items() if np.squeeze(array).ndim == 2}
    if stacks or not single:
        shapes = "; ".join(f"{key} {array.dtype} {array.shape}" for key, array in list(arrays.items())[:8]) or "nothing"
        raise StageError(f"{path} holds no single stack of masks [N,H,W]", HINT, [f"it holds {shapes}"])
    keys = tuple(single)

    def read(_: str, i: int) -> Values:
        values = checked_values(single[keys[i]], f"{keys[i]} in {path}")
        return values, f"npz {values.dtype}"

    return MaskSet(f"npz of {len(keys)} masks", tuple(stem(key) for key in keys), ("",), read)


def as_stack(array: np.ndarray) -> np.ndarray | None:
    """The array as [N,H,W] with N > 1, a channel axis of length 1 dropped; None for any other shape."""
    if array.ndim == 4 and 1 in (array.shape[1], array.shape[3]):
        array = array[:, 0] if array.shape[1] == 1 else array[..., 0]
    return array if array.ndim == 3 and array.shape[0] > 1 else None


def one_stack(
    path: Path, key: str, stack: np.ndarray, arrays: dict[str, np.ndarray], frames: range, film: str
) -> MaskSet:
    """A stack, with its names if there are any."""
    found = next((name for name in NAMES if name in arrays and name != key), None)
    names = None
    if found is None:
        check_one_per_frame(len(stack), frames, f"{key} in {path}", film)
    else:
        names = tuple(stem(name) for name in texts(arrays[found], len(stack), found, path, HINT))

    def read(_: str, i: int) -> Values:
        values = checked_values(np.asarray(stack[i]), f"mask {i} of {key} in {path}")
        return values, f"{path.suffix[1:]} {values.dtype}"

    return MaskSet(f"stack of {len(stack)} masks", names, ("",), read)

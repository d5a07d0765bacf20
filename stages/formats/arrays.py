"""Named arrays from .npz files, and the checks every reader makes on them."""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from stages.contract import StageError


def read_npz(path: Path, hint: str = "", only: Collection[str] = ()) -> dict[str, np.ndarray]:
    """All arrays of an .npz file, or those named in `only`; StageError for a missing, broken or pickled one, with the key."""
    arrays = {}
    key = ""
    try:
        with np.load(path, allow_pickle=False) as data:
            for key in data.files:
                if not only or key in only:
                    arrays[key] = data[key]
    except FileNotFoundError as error:
        raise StageError(f"no file {path}", hint) from error
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        where = f"array {key!r} of {path}" if key else f"{path}"
        raise StageError(f"cannot read {where} without running pickled code", hint, [str(error)]) from error
    return arrays


def take(arrays: Mapping[str, np.ndarray], key: str, path: Path | str, hint: str = "") -> np.ndarray:
    """The array of that name, or a StageError that lists the names there are."""
    if key not in arrays:
        raise StageError(f"{path} has no {key}", hint, [f"it holds {', '.join(sorted(arrays)) or 'nothing'}"])
    return arrays[key]


def checked(array: np.ndarray, shape: tuple[int | None, ...], key: str, path: Path | str, hint: str = "") -> np.ndarray:
    """The array if it has `shape` (None: any length) and finite numbers, else StageError with key, shape, index."""
    found = np.shape(array)
    if len(found) != len(shape) or any(
        want is not None and want != have for want, have in zip(shape, found, strict=True)
    ):
        wanted = "x".join("any" if n is None else str(n) for n in shape) or "a single number"
        facts = [f"found {'x'.join(map(str, found)) or 'a single number'}, wanted {wanted}"]
        raise StageError(f"{key} in {path} has the wrong shape", hint, facts)
    if array.dtype.kind not in "fiub":
        raise StageError(f"{key} in {path} does not hold numbers", hint, [f"its type is {array.dtype}"])
    finite = np.isfinite(array)
    if not finite.all():
        index = np.unravel_index(int(np.flatnonzero(~finite.ravel())[0]), found)
        facts = [f"the first of {(~finite).sum()} stands at {list(map(int, index))}: {array[index]}"]
        raise StageError(f"{key} in {path} has numbers that are not finite", hint, facts)
    return array

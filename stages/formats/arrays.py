"""Named arrays from .npz files, single ones from .npy, and the checks every reader makes on them."""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from stages.contract import StageError
from stages.formats.budget import BUDGET, Budget

BROKEN = (
    *(OSError, ValueError, TypeError, KeyError, EOFError, RuntimeError, OverflowError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError, SyntaxError),
)
"""What Python's zipfile and numpy raise on damaged archives and headers."""
PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
LARGEST = float(np.finfo(np.float32).max)  # what is beyond it is infinite as soon as it is drawn
PIECE = 1 << 20
"""Bytes unpacked at a time, so that a large array is in memory once."""


def read_npz(path: Path, hint: str = "", only: Collection[str] = (), most: int = BUDGET) -> dict[str, np.ndarray]:
    """All arrays of an .npz file, or those named in `only`; StageError for a missing, broken or pickled one, with the key.

    A header cannot claim memory: the file's own bytes count, and at most `most` bytes of packed content.
    """
    arrays = {}
    key = ""
    try:
        data = Path(path).read_bytes()
        budget = Budget(path, len(data), most)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:  # from disk zipfile trusts the headers
            for member in archive.infolist():
                key = member.filename.removesuffix(".npy")
                if only and key not in only:
                    continue
                if member.compress_type not in PLAIN:
                    raise ValueError(f"it is packed by method {member.compress_type}, which numpy does not write")
                budget.spend(member.file_size, f"array {key!r}")
                with archive.open(member) as file:
                    arrays[key] = _array_in(file, member.file_size)
    except FileNotFoundError as error:
        raise StageError(f"no file {path}", hint) from error
    except BROKEN as error:
        where = f"array {key!r} of {path}" if key else f"{path}"
        raise StageError(f"cannot read {where}", hint, [str(error) or type(error).__name__]) from error
    return arrays


def npz_names(path: Path) -> list[str]:
    """What the arrays of an .npz are called, whatever they hold."""
    with zipfile.ZipFile(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read_npy(path: Path, hint: str = "") -> np.ndarray:
    """The array of an .npy file; StageError for a missing, broken or pickled one."""
    try:
        return array_of(Path(path).read_bytes())
    except BROKEN as error:
        raise StageError(f"{path} is not a plain .npy array", hint, [str(error) or type(error).__name__]) from error


def array_of(data: bytes) -> np.ndarray:
    """The array in the bytes of an .npy file; ValueError (or one of BROKEN) where header and content do not fit."""
    return _array_in(io.BytesIO(data), len(data))


def _array_in(file: IO[bytes], length: int) -> np.ndarray:
    """The array in an .npy file that is open and `length` bytes long; errors as `array_of`."""
    shape, fortran, dtype = _header(file)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which only running pickled code could make")
    promised, found = dtype.itemsize * math.prod(shape), length - file.tell()
    if promised != found:
        raise ValueError(f"{promised} bytes of {dtype} {shape} promised, {found} found")
    content = np.empty(promised, np.uint8)
    for start in range(0, promised, PIECE):
        place = content[start : start + PIECE]
        piece = file.read(len(place))
        if len(piece) != len(place):
            raise ValueError(f"it ends after {start + len(piece)} bytes of {promised}")
        place[:] = np.frombuffer(piece, np.uint8)
    array = content.view(dtype).reshape(shape, order="F" if fortran else "C")
    array = array.copy() if fortran else array
    check_letters(array)
    return array


def check_letters(array: np.ndarray) -> None:
    """ValueError for text with code points outside Unicode: numpy would make broken Python strings."""
    if array.dtype.kind == "U" and array.size:
        codes = np.frombuffer(array.tobytes(), np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
        wrong = codes[(codes > 0x10FFFF) | ((codes >= 0xD800) & (codes < 0xE000))]
        if len(wrong):
            raise ValueError(f"a text has the letter {int(wrong[0]):#x}, which Unicode has not")


def npy_header(data: bytes) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, column order, type, and where the content begins."""
    file = io.BytesIO(data)
    return *_header(file), file.tell()


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, column order and type of an .npy file; the content follows."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if min(shape, default=0) < 0:
        raise ValueError(f"its shape is {shape}")
    return shape, fortran, dtype


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write named arrays as .npz."""
    np.savez(path, **arrays)


def take(arrays: Mapping[str, np.ndarray], key: str, path: Path | str, hint: str = "") -> np.ndarray:
    """The array of that name, or a StageError that lists the names there are."""
    if key not in arrays:
        raise StageError(f"{path} has no {key}", hint, [f"it holds {', '.join(sorted(arrays)) or 'nothing'}"])
    return arrays[key]


def checked(value: object, shape: tuple[int | None, ...], key: str, path: Path | str, hint: str = "") -> np.ndarray:
    """The array if it has `shape` (None: any length) and finite numbers, else StageError with key, shape, index."""
    array = as_array(value, key, path, hint)
    found = array.shape
    if len(found) != len(shape) or any(
        want is not None and want != have for want, have in zip(shape, found, strict=True)
    ):
        wanted = "x".join("any" if n is None else str(n) for n in shape) or "a single number"
        facts = [f"found {'x'.join(map(str, found)) or 'a single number'}, wanted {wanted}"]
        raise StageError(f"{key} in {path} has the wrong shape", hint, facts)
    if array.dtype.kind not in "fiub":
        raise StageError(f"{key} in {path} does not hold numbers", hint, [f"its type is {array.dtype}"])
    wide = array.dtype.kind == "f" and array.dtype.itemsize > 4
    finite = np.abs(array) <= LARGEST if wide else np.isfinite(array)
    if not finite.all():
        index = np.unravel_index(int(np.flatnonzero(~finite.ravel())[0]), found)
        facts = [f"the first of {(~finite).sum()} stands at {list(map(int, index))}: {array[index]}"]
        raise StageError(f"{key} in {path} has numbers that are not finite", hint, facts)
    return array


def as_array(value: object, key: str, path: Path | str, hint: str = "") -> np.ndarray:
    """An array, or nested lists made one; StageError for lists of unequal length."""
    try:
        return np.asarray(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise StageError(f"{key} in {path} is not an array", hint, [str(error)]) from error


def texts(array: np.ndarray, count: int, key: str, path: Path | str, hint: str = "") -> list[str]:
    """The `count` texts of an array, whole numbers as texts; StageError for anything else."""
    if array.shape != (count,) or array.dtype.kind not in "USiu":
        facts = [f"found {array.dtype} {array.shape}, wanted {count} texts or whole numbers"]
        raise StageError(f"{key} in {path} does not name all rows", hint, facts)
    return [one.decode(errors="replace") if isinstance(one, bytes) else str(one) for one in array.tolist()]


def check_radians(rotvecs: np.ndarray, key: str, path: Path | str) -> None:
    """StageError if rotation vectors [N,J,3] turn so far that they must be in degrees."""
    angles = np.linalg.norm(rotvecs, axis=2)
    if angles.size and angles.max() > 4 * np.pi:
        row, joint = (int(i) for i in np.unravel_index(angles.argmax(), angles.shape))
        facts = [f"row {row}, joint {joint} turns by {angles.max():.1f}"]
        raise StageError(f"{key} in {path} looks like degrees", "rotation vectors are in radians", facts)

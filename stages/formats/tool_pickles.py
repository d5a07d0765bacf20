"""Pickled files of other programs: joblib, torch.save, object arrays of numpy. Nothing of them is run.

| file begins with | what it is                                                                    |
|------------------|-------------------------------------------------------------------------------|
| PK               | torch.save's zip (NAME/data.pkl, NAME/data/KEY), or an .npz                   |
| \\x93NUMPY        | .npy                                                                          |
| x                | joblib.dump, compressed by zlib                                               |
| anything else    | pickle: joblib.dump (arrays follow their NumpyArrayWrapper), or old torch.save |

Sources: joblib/numpy_pickle.py, torch/serialization.py, numpy.lib.format.
"""

from __future__ import annotations

import io
import math
import pickle
import struct
import zipfile
import zlib
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import BROKEN, PIECE, PLAIN, array_of, npy_header
from stages.formats.budget import Budget
from stages.formats.kinds import kind_of
from stages.formats.safe_pickle import ArraysOnly, plain, refuse_code, size_of

OLD_TORCH = 0x1950A86A20F9469CFC6C  # the first of the pickles in a file of old torch.save
_STORAGES = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}
_PLAIN = {
    ("collections", "OrderedDict"): OrderedDict,
    ("collections", "defaultdict"): defaultdict,
    ("builtins", "dict"): dict,
    ("builtins", "list"): list,
    ("torch", "Size"): tuple,
}
_BROKEN = (
    *BROKEN,
    *(pickle.UnpicklingError, struct.error, ArithmeticError, AssertionError, AttributeError, ImportError, LookupError),
    *(NotImplementedError, RecursionError),
)


def read_tool_file(path: Path, hint: str = "") -> Any:
    """Numbers, texts, lists, dictionaries and arrays of a file; tensors are arrays too, an .npz is a dictionary.

    Raises StageError for a file that is broken, or that asks for anything else than these.
    """
    try:
        data = Path(path).read_bytes()
        budget = Budget(path, len(data))
        return _plain(_load(data, budget), iter(range(budget.spent + len(data))), Path(path))
    except OSError as error:
        raise StageError(f"cannot open {path}", hint, [str(error)]) from error
    except _BROKEN as error:
        if (kind := kind_of(path)) and kind.what in ("picture", "sound"):
            raise StageError(f"{path} is {kind}", hint) from error
        raise StageError(f"{path} cannot be read without running what it holds", hint, [f"{error}"[:300]]) from error


def read_named(path: Path, hint: str = "") -> dict[str, Any]:
    """The dictionary in a pickle, or in an .npy file of one object; StageError as `read_tool_file`, or for another thing."""
    content = read_tool_file(path, hint)
    if not isinstance(content, dict):
        raise StageError(f"{path} holds a {type(content).__name__}, not named arrays", hint)
    budget = Budget(path, path.stat().st_size)
    for key, value in content.items():
        budget.spend(size_of(value), f"{key}")
    return {str(key): value for key, value in content.items()}


def _load(data: bytes, budget: Budget) -> Any:
    """The content of a file; `budget` pays for what unpacks."""
    if data[:2] == b"PK":
        return _unzip(zipfile.ZipFile(io.BytesIO(data)), budget)
    if data[:6] == b"\x93NUMPY":
        return _npy(data, budget)
    if data[:1] == b"x":
        data = _unpacked(data, budget)
    file = io.BytesIO(data)
    first = ToolObjects(file, budget).load()
    return _old_torch(file, budget) if isinstance(first, int) and first == OLD_TORCH else first


def _unpacked(data: bytes, budget: Budget) -> bytes:
    """What zlib packed, piece by piece, as the stream does not tell its length."""
    unpacker, pieces = zlib.decompressobj(), []
    while data and not unpacker.eof:
        pieces.append(unpacker.decompress(data, PIECE))
        data = unpacker.unconsumed_tail
        budget.spend(len(pieces[-1]), "unpacked, it")
    return b"".join(pieces)


def _npy(data: bytes, budget: Budget) -> Any:
    """The array in the bytes of an .npy file, or the objects."""
    _, _, dtype, start = npy_header(data)
    return ToolObjects(io.BytesIO(data[start:]), budget).load() if dtype.hasobject else array_of(data)


def _unzip(archive: zipfile.ZipFile, budget: Budget) -> Any:
    names = archive.namelist()
    if other := {one.compress_type for one in archive.infolist()} - set(PLAIN):
        raise ValueError(f"it is packed by method {other.pop()}, which neither numpy nor torch writes")
    budget.spend(sum(one.file_size for one in archive.infolist()), "unpacked, it")
    pickled = [name for name in names if name.rpartition("/")[2] == "data.pkl"]
    if not pickled:
        return {name.removesuffix(".npy"): _npy(archive.read(name), budget) for name in names}
    folder = pickled[0].removesuffix("data.pkl")
    order = f"{folder}byteorder"
    if order in names and archive.read(order).strip() != b"little":
        raise pickle.UnpicklingError("its numbers are not little-endian")

    @cache
    def stored(key: str) -> bytes:
        return archive.read(f"{folder}data/{key}")

    def storage(dtype: np.dtype, key: str, count: int) -> np.ndarray:
        return np.frombuffer(stored(key), dtype, count)

    return ToolObjects(io.BytesIO(archive.read(pickled[0])), budget, storage).load()


def _old_torch(file: io.BytesIO, budget: Budget) -> Any:
    """What old torch.save wrote after its magic number: version, host, the object, its storages' keys, their numbers."""
    ToolObjects(file, budget).load()
    if not ToolObjects(file, budget).load().get("little_endian", True):
        raise pickle.UnpicklingError("its numbers are not little-endian")
    room = file.getbuffer().nbytes
    storages: dict[str, np.ndarray] = {}

    def storage(dtype: np.dtype, key: str, count: int) -> np.ndarray:
        taken = sum(one.nbytes for one in storages.values())
        if key not in storages and not 0 <= count * dtype.itemsize <= room - taken:
            raise pickle.UnpicklingError(f"a storage of {count} numbers does not fit the file")
        return storages[key] if key in storages else storages.setdefault(key, np.zeros(count, dtype))

    content = ToolObjects(file, budget, storage).load()
    for key in ToolObjects(file, budget).load():
        (count,) = struct.unpack("<q", file.read(8))
        if count != len(storages[key]):
            raise pickle.UnpicklingError(f"storage {key} has {count} numbers, not {len(storages[key])}")
        storages[key][:] = np.frombuffer(file.read(storages[key].nbytes), storages[key].dtype)
    return content


class _JoblibArray:
    """Stands for an array whose numbers follow in the file."""

    file: io.BytesIO
    budget: Budget
    array: np.ndarray | None = None

    def __setstate__(self, state: dict[str, Any]) -> None:
        dtype, shape = state["dtype"].dtype(), tuple(int(n) for n in state["shape"])
        if dtype.hasobject:
            self.array = ToolObjects(self.file, self.budget).load()
            return
        if state.get("numpy_array_alignment_bytes"):
            self.file.read(self.file.read(1)[0])
        count = int(np.prod([np.float64(n) for n in shape]))
        if min(shape, default=0) < 0 or count * dtype.itemsize > self.file.getbuffer().nbytes:
            raise pickle.UnpicklingError(f"an array of shape {shape} does not fit the file")
        numbers = np.frombuffer(self.file.read(count * dtype.itemsize), dtype, count)
        self.array = numbers.reshape(shape, order="F" if state["order"] == "F" else "C")


class ToolObjects(ArraysOnly):
    """ArraysOnly, and joblib's arrays and torch's tensors; `storage` gives a tensor's numbers by type, key and count."""

    stand_ins = (*ArraysOnly.stand_ins, _JoblibArray)

    def __init__(
        self,
        file: io.BytesIO,
        budget: Budget,
        storage: Callable[[np.dtype, str, int], np.ndarray] | None = None,
        encoding: str = "latin1",
    ):
        super().__init__(file, encoding, budget)
        self.file, self.storage = file, storage

    def persistent_load(self, key: object) -> np.ndarray:
        if not isinstance(key, tuple) or len(key) < 5:
            raise pickle.UnpicklingError(f"it refers to {key!r}")
        kind, dtype, name, _, count = key[:5]
        if self.storage is None or kind != "storage" or not isinstance(dtype, np.dtype):
            raise pickle.UnpicklingError(f"it refers to {key!r}")
        return self.storage(dtype, str(name), int(count))

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _PLAIN:
            return _PLAIN[module, name]
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        if module == "torch._utils" and name == "_rebuild_tensor_v2":
            return partial(_tensor, self.budget)
        if module == "torch._utils" and name == "_rebuild_parameter":
            return lambda tensor, *rest: tensor
        if module == "torch.storage" and name == "_load_from_bytes":
            return partial(_load, budget=self.budget)
        if (module, name) == ("joblib.numpy_pickle", "NumpyArrayWrapper"):
            return type(name, (_JoblibArray,), {"file": self.file, "budget": self.budget})
        return super().find_class(module, name)


def _tensor(budget: Budget, storage: np.ndarray, offset: int, shape: tuple, stride: tuple, *rest: Any) -> np.ndarray:
    """The tensor [shape] that lies in flat `storage` from `offset` on, `stride` elements apart; a view.

    Computes with Python's int: numpy's wraps at 64 bits, and a tensor outside its storage would seem to fit.
    """
    if not isinstance(storage, np.ndarray) or storage.ndim != 1 or not storage.flags.c_contiguous:
        raise pickle.UnpicklingError("a tensor's numbers are not where they should be")
    offset, shape, stride = int(offset), tuple(map(int, shape)), tuple(map(int, stride))
    if len(shape) != len(stride) or min((*shape, *stride, offset), default=0) < 0:
        raise pickle.UnpicklingError(f"a tensor has shape {shape} and strides {stride}")
    last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True))
    if 0 not in shape and last >= len(storage):
        raise pickle.UnpicklingError(f"a tensor of shape {shape} does not fit its {len(storage)} numbers")
    budget.spend(max(0, math.prod(shape) - len(storage)) * storage.itemsize, f"a tensor of shape {shape}")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False)


def _plain(value: Any, left: Iterator[int], path: Path, key: str = "a value") -> Any:
    """`value` with stand-ins turned into arrays, all the way down; arrays of objects become lists. Errors name `path` and `key`.

    `left` runs out where lists that hold each other stand for more than the file has.
    """
    if next(left, None) is None:
        raise pickle.UnpicklingError("it repeats itself endlessly")
    refuse_code(value)
    if isinstance(value, _JoblibArray):
        return _plain(value.array, left, path, key)
    if isinstance(value, dict):
        return {_plain(k, left, path): _plain(one, left, path, str(k)) for k, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return type(value)(_plain(one, left, path, key) for one in value)
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        listed = value.item() if value.ndim == 0 else list(value)
        return _plain(listed, left, path, key)
    return plain(value, f"{key} in {path}")

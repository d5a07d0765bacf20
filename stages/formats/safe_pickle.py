"""Arrays out of pickles, without running what the pickle asks for.

Pickles name functions to call. This reader makes arrays only: stand-ins of ours replace numpy's functions that rebuild
them, inert ones the chumpy and scipy.sparse objects of SMPL files (neither package is needed). Every other name is
refused, and so is a size that the file itself does not hold: numpy's own classes and the unpickler in C trust both.
"""

from __future__ import annotations

import math
import pickle
import re
import struct
from collections.abc import Callable
from typing import IO, Any, ClassVar, Literal, cast

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import check_letters
from stages.formats.budget import Budget

_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")
_ELSEWHERE = (pickle.NEXT_BUFFER, pickle.READONLY_BUFFER)
"""Opcodes for content outside of the pickle."""
_BUILD: Callable[[Any], None] = pickle._Unpickler.dispatch[pickle.BUILD[0]]
_TYPE = re.compile(r"[biufc]\d{1,2}|[SU]\d{1,5}|O8?")
_DENSE = 1 << 24
"""Most numbers of a sparse matrix made dense; SMPL-X's largest has half a million."""


class _Inert:
    """What stands in for an object of another package: its name and the state it was pickled with, nothing else."""

    kind = ""
    budget: Budget

    def __new__(cls, *args: Any, **kwargs: Any) -> _Inert:
        return object.__new__(cls)

    def __setstate__(self, state: Any) -> None:
        self.__dict__["state"] = state if isinstance(state, dict) else {}


def refuse_code(value: object) -> None:
    """UnpicklingError for a function or a class that was named and not called: only data may come out."""
    if callable(value) and not (isinstance(value, type) and issubclass(value, _Inert)):
        raise pickle.UnpicklingError(f"it holds {getattr(value, '__name__', value)!r}, which is no data")


def size_of(value: object) -> int:
    """Bytes of a list of arrays that becomes one: many may be the same one in memory."""
    if isinstance(value, (list, tuple)):
        return sum(one.nbytes if isinstance(one, np.ndarray) else size_of(one) for one in value)
    return 0


def plain(value: object, name: str) -> Any:
    """`value` with stand-ins turned into the arrays they hold, each once; StageError naming `name` if that is not possible."""
    if isinstance(value, _Array):
        return value.view(np.ndarray)
    if not isinstance(value, _Inert):
        return value
    state = getattr(value, "state", {})
    if "made" not in vars(value):
        vars(value)["made"] = _made(value, state, name)
    return vars(value)["made"]


def _made(value: _Inert, state: dict[str, Any], name: str) -> np.ndarray:
    try:
        if value.kind.startswith("scipy.sparse"):
            return _dense(value.kind, state, value.budget)
        content = plain(state["x" if "chumpy.reordering" not in value.kind else "a"], name)
        value.budget.spend(size_of(content), name)
        array = np.asarray(content)
        if array.dtype.kind not in "fiub":
            raise ValueError(f"it holds {array.dtype}, not numbers")
        if value.kind == "chumpy.reordering.Select":
            index = np.asarray(state["idxs"])
            value.budget.spend(index.size * array.itemsize, f"{name}, {index.size} chosen numbers,")
            chosen = array.ravel()[index]
            return chosen.reshape(state.get("preferred_shape", chosen.shape))
        return array.reshape(state["newshape"]) if value.kind == "chumpy.reordering.Reshape" else array
    except (KeyError, IndexError, ValueError, TypeError, RecursionError) as error:
        facts = [f"it is a {value.kind} with {', '.join(sorted(map(str, state))) or 'no state'}: {error!r}"]
        raise StageError(f"{name} is an object whose numbers cannot be read", "", facts) from error


def _dense(kind: str, state: dict[str, Any], budget: Budget) -> np.ndarray:
    shape = tuple(int(n) for n in (state["_shape"] if "_shape" in state else state["shape"]))
    dtype = np.asarray(state["data"]).dtype
    if math.prod(shape) > _DENSE or dtype.kind not in "fiub":
        raise ValueError(f"its shape is {shape} of {dtype}")
    budget.spend(math.prod(shape) * dtype.itemsize, "a sparse matrix")
    dense = np.zeros(shape, dtype)
    if "indptr" in state:
        lengths = np.diff(state["indptr"])
        if lengths.min() < 0 or lengths.sum() != len(state["data"]):
            raise ValueError(f"its rows have {lengths.sum()} numbers of {len(state['data'])}")
        outer = np.repeat(np.arange(len(lengths)), lengths)
        index = (outer, state["indices"]) if "csr" in kind else (state["indices"], outer)
    else:
        index = state["coords"] if "coords" in state else (state["row"], state["col"])
    np.add.at(dense, tuple(index), state["data"])
    return dense


class Type:
    """What stands in for numpy.dtype: plain numbers, texts and objects, in either byte order."""

    def __init__(self, code: str, *_: object):
        self.code, self.order = str(code), "="

    def __setstate__(self, state: Any) -> None:
        self.order = str(state[1])

    def dtype(self) -> np.dtype:
        """The type; UnpicklingError for any other than those above."""
        if not _TYPE.fullmatch(self.code) or self.order not in ("<", ">", "=", "|"):
            raise pickle.UnpicklingError(f"it has an array of type {self.order}{self.code}")
        return np.dtype(self.code).newbyteorder(cast(Literal["<", ">", "=", "|"], self.order))


class _Array(np.ndarray):
    """What stands in for numpy.ndarray: takes content that is as long as its shape says, and no other."""

    def __setstate__(self, state: Any) -> None:
        *_, shape, kind, fortran, content = state
        shape, dtype = tuple(int(n) for n in shape), kind.dtype()
        content = content.encode("latin1") if isinstance(content, str) else content
        length = math.prod(shape) * (1 if dtype.hasobject else dtype.itemsize)
        if min(shape, default=0) < 0 or len(content) != length or isinstance(content, list) != dtype.hasobject:
            raise pickle.UnpicklingError(f"{length} long content of {dtype} {shape} promised, {len(content)} found")
        super().__setstate__((1, shape, dtype, bool(fortran), content))  # type: ignore[arg-type]  # numpy's stub wants its own bool
        check_letters(self)


def _empty_array(*_: object) -> _Array:
    """What pickles call numpy's _reconstruct for: an array whose content follows."""
    return _Array(0, np.uint8)


def _scalar(kind: Type, content: bytes | str) -> Any:
    """What pickles call numpy's scalar for: one number."""
    return np.frombuffer(content.encode("latin1") if isinstance(content, str) else content, kind.dtype())[0]


def _from_buffer(
    content: bytes, kind: Type, shape: tuple[int, ...], order: Literal["C", "F"], *_: object
) -> np.ndarray:
    return np.frombuffer(content, kind.dtype()).reshape(shape, order=order)


def _bare_object(cls: type, base: type, state: Any) -> Any:
    """What old pickles call copy_reg._reconstructor for: an empty object, here of an inert class only."""
    if not (isinstance(cls, type) and issubclass(cls, _Inert) and base is object):
        raise pickle.UnpicklingError(f"it rebuilds a {cls!r}")
    return cls()


def _latin1(text: str, encoding: str = "latin1") -> bytes:
    return text.encode("latin1")


class ArraysOnly(pickle._Unpickler):
    """Python's own unpickler: its memo is a dictionary, while C's is a table as large as the file asks."""

    def __init__(self, file: IO[bytes], encoding: str, budget: Budget):
        """`budget` pays for what objects unfold to."""
        super().__init__(file, encoding=encoding)
        self.budget = budget

    read: Callable[[int], bytes]
    append: Callable[[Any], None]
    stack: list[Any]
    stand_ins: ClassVar[tuple[type, ...]] = (_Inert, _Array, Type)
    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        code: load for code, load in pickle._Unpickler.dispatch.items() if bytes([code]) not in _ELSEWHERE
    }

    def load_bytearray8(self) -> None:
        """As the base class does, but takes memory only for bytes that are there."""
        (length,) = struct.unpack("<Q", self.read(8))
        self.append(bytes(self.read(length)))

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8

    def load_build(self) -> None:
        """As the base class does, for stand-ins alone; what a dictionary has beside its entries is left out.

        Setting a function's state would change it for every file that follows.
        """
        holder = self.stack[-2]
        if isinstance(holder, dict):
            self.stack.pop()
        elif isinstance(holder, self.stand_ins):
            _BUILD(self)
        else:
            raise pickle.UnpicklingError(f"it changes {getattr(holder, '__name__', type(holder).__name__)!r}")

    dispatch[pickle.BUILD[0]] = load_build

    def find_class(self, module: str, name: str) -> Any:
        if module in _MODULES and name in ("_reconstruct", "scalar"):
            return {"_reconstruct": _empty_array, "scalar": _scalar}[name]
        if module in ("numpy.core.numeric", "numpy._core.numeric") and name == "_frombuffer":
            return _from_buffer  # pickle protocol 5
        if module == "numpy" and name in ("ndarray", "dtype"):
            return {"ndarray": None, "dtype": Type}[name]
        if module in ("__builtin__", "builtins") and name in ("object", "set", "frozenset"):
            return {"object": object, "set": set, "frozenset": frozenset}[name]
        if module in ("copy_reg", "copyreg") and name == "_reconstructor":
            return _bare_object
        if module == "_codecs" and name == "encode":
            return _latin1
        if module.split(".")[0] == "chumpy" or (
            module.startswith("scipy.sparse") and name[:3] in ("csc", "csr", "coo")
        ):
            return type(name, (_Inert,), {"kind": f"{module}.{name}", "budget": self.budget})
        raise pickle.UnpicklingError(f"it would load {module}.{name}, which is refused")

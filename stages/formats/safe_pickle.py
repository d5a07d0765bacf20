"""Arrays out of pickles, without running what the pickle asks for.

Pickles name functions to call. This reader knows arrays only: numpy's own rebuilding, and inert stand-ins for the
chumpy and scipy.sparse objects found in SMPL files (neither package is needed). Every other name is refused.
"""

from __future__ import annotations

import pickle
import tokenize
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy._core.multiarray import _reconstruct, scalar

from stages.contract import StageError

_MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")
_BROKEN = (pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError, KeyError, TypeError, ValueError)


class _Inert:
    """What stands in for an object of another package: its name and the state it was pickled with, nothing else."""

    kind = ""

    def __new__(cls, *args: Any, **kwargs: Any) -> _Inert:
        return object.__new__(cls)

    def __setstate__(self, state: Any) -> None:
        self.__dict__["state"] = state if isinstance(state, dict) else {}


def read_pickle(path: Path, hint: str = "") -> dict[str, Any]:
    """The pickled dictionary in `path`, arrays made plain numpy; StageError if it is broken or asks for code."""
    try:
        with open(path, "rb") as file:
            content = ArraysOnly(file, encoding="latin1").load()
    except OSError as error:
        raise StageError(f"cannot open {path}", hint, [str(error)]) from error
    except _BROKEN as error:
        raise StageError(f"{path} is not a pickle of plain arrays", hint, [f"{error}"]) from error
    if not isinstance(content, dict):
        raise StageError(f"{path} holds a {type(content).__name__}, not named arrays", hint)
    return {str(key): plain(value, f"{key} in {path}") for key, value in content.items()}


def read_object_npy(path: Path, hint: str = "") -> dict[str, Any]:
    """The dictionary that numpy.save put into `path`; StageError if there is none, or if it holds more than arrays."""
    try:
        with open(path, "rb") as file:
            content = read_npy(file, ArraysOnly)
    except OSError as error:
        raise StageError(f"cannot open {path}", hint, [str(error)]) from error
    except _BROKEN as error:
        raise StageError(f"{path} is not a .npy file of plain arrays", hint, [f"{error}"]) from error
    content = content.item() if isinstance(content, np.ndarray) and content.size == 1 else content
    if not isinstance(content, dict):
        raise StageError(f"{path} holds no named arrays", hint)
    return {str(key): plain(value, f"{key} in {path}") for key, value in content.items()}


def read_npy(file: BinaryIO, unpickler: type[ArraysOnly]) -> Any:
    """The array of an open .npy file; objects in it by `unpickler`. Raises ValueError or EOFError if it is broken."""
    start = file.tell()
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        dtype = read(file)[2]
    except (SyntaxError, tokenize.TokenError) as error:
        raise ValueError(f"its header is damaged: {error}") from error
    if dtype.hasobject:
        return unpickler(file, encoding="latin1").load()
    file.seek(start)
    return np.lib.format.read_array(file, allow_pickle=False)


def plain(value: Any, name: str) -> Any:
    """`value` with stand-ins turned into the arrays they hold; StageError naming `name` if that is not possible."""
    if not isinstance(value, _Inert):
        return value
    state = getattr(value, "state", {})
    try:
        if value.kind.startswith("scipy.sparse"):
            return _dense(value.kind, state)
        if value.kind == "chumpy.reordering.Select":
            chosen = np.asarray(plain(state["a"], name)).ravel()[np.asarray(state["idxs"])]
            return chosen.reshape(state.get("preferred_shape", chosen.shape))
        if value.kind == "chumpy.reordering.Reshape":
            return np.asarray(plain(state["a"], name)).reshape(state["newshape"])
        return np.asarray(plain(state["x"], name))
    except (KeyError, IndexError, ValueError, TypeError) as error:
        facts = [f"it is a {value.kind} with {', '.join(sorted(map(str, state))) or 'no state'}: {error!r}"]
        raise StageError(f"{name} is an object whose numbers cannot be read", "", facts) from error


def _dense(kind: str, state: dict[str, Any]) -> np.ndarray:
    shape = tuple(int(n) for n in state.get("_shape", state.get("shape")))
    dense = np.zeros(shape, np.asarray(state["data"]).dtype)
    if "indptr" in state:
        lengths = np.diff(state["indptr"])
        outer = np.repeat(np.arange(len(lengths)), lengths)
        index = (outer, state["indices"]) if "csr" in kind else (state["indices"], outer)
    else:
        index = state["coords"] if "coords" in state else (state["row"], state["col"])
    np.add.at(dense, tuple(index), state["data"])
    return dense


def _bare_object(cls: type, base: type, state: Any) -> Any:
    """What old pickles call copy_reg._reconstructor for: an empty object, here of an inert class only."""
    if not (isinstance(cls, type) and issubclass(cls, _Inert) and base is object):
        raise pickle.UnpicklingError(f"it rebuilds a {cls!r}")
    return cls()


def _latin1(text: str, encoding: str = "latin1") -> bytes:
    return text.encode("latin1")


def _from_buffer(buffer: Any, dtype: np.dtype, shape: tuple[int, ...], order: str, *rest: Any) -> np.ndarray:
    return np.frombuffer(buffer, dtype).reshape(shape, order=order)


class ArraysOnly(pickle.Unpickler):
    """Builds numbers, texts, containers, arrays and inert stand-ins; any other name is an UnpicklingError."""

    def find_class(self, module: str, name: str) -> Any:
        if module in _MODULES and name in ("_reconstruct", "scalar"):
            return {"_reconstruct": _reconstruct, "scalar": scalar}[name]
        if module in ("numpy.core.numeric", "numpy._core.numeric") and name == "_frombuffer":
            return _from_buffer  # pickle protocol 5
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        if module in ("__builtin__", "builtins") and name in ("object", "set", "frozenset"):
            return {"object": object, "set": set, "frozenset": frozenset}[name]
        if module in ("copy_reg", "copyreg") and name == "_reconstructor":
            return _bare_object
        if module == "_codecs" and name == "encode":
            return _latin1
        if module.split(".")[0] == "chumpy" or (
            module.startswith("scipy.sparse") and name[:3] in ("csc", "csr", "coo")
        ):
            return type(name, (_Inert,), {"kind": f"{module}.{name}"})
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is refused")

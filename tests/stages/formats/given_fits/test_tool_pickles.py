"""Arrays and tensors come out of joblib's, torch's and numpy's files as they went in, and nothing else does."""

from __future__ import annotations

import io
import pickle
from collections import OrderedDict, defaultdict

import numpy as np
import pytest
import torch

from stages.contract import StageError
from stages.formats.given_fits.tool_pickles import OLD_TORCH, read_tool_file
from tests.made.fits import joblib_dump

TYPES = (torch.float64, torch.float32, torch.float16, torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)


def tensors():
    base = torch.arange(24, dtype=torch.float32).reshape(2, 3, 4)
    found = {f"{kind}": torch.arange(6).reshape(2, 3).to(kind) for kind in TYPES}
    found |= {"views": [base.permute(2, 0, 1), base[1], base[:, 1:, ::2]], "bool": torch.tensor([True, False])}
    found |= {"number": torch.tensor(2.5), "none": torch.zeros(0, 3), "size": base.shape, "text": "a", "nothing": None}
    return found | {"ordered": OrderedDict(p=torch.nn.Parameter(torch.ones(2)))}


def same(found, wanted):
    if isinstance(wanted, dict):
        assert list(found) == list(wanted)
        for key in wanted:
            same(found[key], wanted[key])
    elif isinstance(wanted, list | tuple):
        assert len(found) == len(wanted)
        for a, b in zip(found, wanted, strict=True):
            same(a, b)
    elif isinstance(wanted, torch.Tensor):
        wanted = wanted.detach().numpy()
        assert isinstance(found, np.ndarray) and found.dtype == wanted.dtype and found.shape == wanted.shape
        np.testing.assert_array_equal(found, wanted)
    elif isinstance(wanted, np.ndarray):
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)
    else:
        assert found == wanted


@pytest.mark.parametrize("how", ["new", "old", "in .npy", "in .npz", "in joblib"])
def test_tensors(tmp_path, how):
    content, path = tensors(), tmp_path / "a"
    if how in ("new", "old"):
        torch.save(content, path, _use_new_zipfile_serialization=how == "new")
    elif how == "in .npy":
        with open(path, "wb") as file:
            np.save(file, content, allow_pickle=True)
    elif how == "in .npz":
        with open(path, "wb") as file:
            np.savez(file, a=np.array(content))
        content = {"a": content}
    else:
        joblib_dump(content, path)
    same(read_tool_file(path), content)


@pytest.mark.parametrize("compress", [False, True])
def test_joblib(tmp_path, compress):
    content = defaultdict(dict)
    content[0]["f"] = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    content[0]["c"], content[0]["none"] = np.arange(6, dtype=">i2").reshape(3, 2), np.zeros((0, 4))
    content[1]["list"], content[1]["number"] = [np.float32(2.5), np.arange(3), "a", None], np.array(7)
    joblib_dump(content, tmp_path / "a", compress)
    same(read_tool_file(tmp_path / "a"), dict(content))


def test_arrays_of_objects_become_lists(tmp_path):
    people = np.empty(2, object)
    people[:] = [{"cam": np.ones(3)}, {"cam": np.zeros(3)}]
    np.savez(tmp_path / "a.npz", results=people, one={"k": 1}, plain=np.arange(3))
    wanted = {"results": [{"cam": np.ones(3)}, {"cam": np.zeros(3)}], "one": {"k": 1}, "plain": np.arange(3)}
    same(read_tool_file(tmp_path / "a.npz"), wanted)


class Call:
    def __init__(self, function, *arguments):
        self.reduced = function, arguments

    def __reduce__(self):
        return self.reduced


def hostile():
    rebuild, load = torch._utils._rebuild_tensor_v2, torch.storage._load_from_bytes
    yield "torch.load", Call(torch.load, "x"), "refused"
    yield "numpy.load", Call(np.load, "x"), "refused"
    yield "getattr", Call(getattr, "x", "upper"), "refused"
    yield "a tensor of nothing", Call(rebuild, "x", 0, (2,), (1,), False, OrderedDict()), "not where"
    yield "too large", Call(rebuild, np.zeros(4), 0, (9,), (1,), False, OrderedDict()), "does not fit"
    yield "before its start", Call(rebuild, np.zeros(4), -8, (2,), (1,), False, OrderedDict()), "strides"
    yield "backwards", Call(rebuild, np.zeros(4), 3, (4,), (-1,), False, OrderedDict()), "strides"
    yield "a huge storage", Call(load, old_storage(10**15)), "does not fit"


def old_storage(count):
    """Bytes of an old torch.save whose storage claims `count` numbers."""

    spot = object()

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            return ("storage", torch.FloatStorage, "0", "cpu", count, None) if value is spot else None

    file = io.BytesIO()
    for value in (OLD_TORCH, 1001, {"little_endian": True}):
        pickle.dump(value, file, 2)
    Pickler(file, 2).dump(spot)
    pickle.dump(["0"], file, 2)
    return file.getvalue() + count.to_bytes(8, "little") + bytes(8)


@pytest.mark.parametrize("attack,words", [pytest.param(a, w, id=i) for i, a, w in hostile()])
def test_hostile_pickles_are_refused(tmp_path, attack, words):
    (tmp_path / "a").write_bytes(pickle.dumps({"a": attack}))
    with pytest.raises(StageError) as caught:
        read_tool_file(tmp_path / "a", "a hint")
    assert words in caught.value.facts[0] and caught.value.hint == "a hint"
    assert caught.value.problem == f"{tmp_path / 'a'} cannot be read without running what it holds"


def test_a_value_that_holds_itself_is_refused(tmp_path):
    endless = []
    endless.append(endless)
    (tmp_path / "a").write_bytes(pickle.dumps(endless))
    with pytest.raises(StageError, match="cannot be read"):
        read_tool_file(tmp_path / "a")

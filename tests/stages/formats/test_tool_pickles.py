"""Arrays and tensors come out of joblib's, torch's and numpy's files as they went in, and nothing else does."""

from __future__ import annotations

import io
import pickle
import tracemalloc
import zipfile
import zlib
from _codecs import encode
from collections import OrderedDict, defaultdict

import numpy as np
import pytest
import torch

from stages.contract import StageError
from stages.formats.budget import Budget
from stages.formats.tool_pickles import OLD_TORCH, read_tool_file
from tests.made.fits import joblib_dump
from tests.made.said import holds

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


class Built:
    """Pickled as `what`, to which state is given."""

    def __init__(self, what=encode):
        self.what = what


class Builds(pickle._Pickler):
    """Writes a Built, which Python itself would call before it gives state."""

    def save(self, value, *rest):
        if not isinstance(value, Built):
            return super().save(value, *rest)
        self.save_global(value.what)
        super().save((None, {"__defaults__": ("utf-7",)}))
        self.write(pickle.BUILD)


def pickled(value):
    file = io.BytesIO()
    Builds(file, 2).dump(value)
    return file.getvalue()


def hostile():
    rebuild, load = torch._utils._rebuild_tensor_v2, torch.storage._load_from_bytes
    yield "torch.load", Call(torch.load, "x"), "refused"
    yield "numpy.load", Call(np.load, "x"), "refused"
    yield "getattr", Call(getattr, "x", "upper"), "refused"
    yield "a tensor of nothing", Call(rebuild, "x", 0, (2,), (1,), False, OrderedDict()), "not where"
    yield "too large", Call(rebuild, np.zeros(4), 0, (9,), (1,), False, OrderedDict()), "does not fit"
    yield "before its start", Call(rebuild, np.zeros(4), -8, (2,), (1,), False, OrderedDict()), "strides"
    yield "backwards", Call(rebuild, np.zeros(4), 3, (4,), (-1,), False, OrderedDict()), "strides"
    wide, off = np.int64(2**62 + 1), np.int64(2**62)
    yield "a stride that wraps", Call(rebuild, np.zeros(4), 0, (np.int64(400003),), (wide,), False), "does not fit"
    yield (
        "a shape that wraps",
        Call(rebuild, np.zeros(4), 0, (np.int64(2**32 + 1),), (np.int64(2**32),)),
        "does not fit",
    )
    yield "an offset that wraps", Call(rebuild, np.zeros(4), off, (np.int64(2), 2), (off, off), False), "does not fit"
    yield "one too many", Call(rebuild, np.zeros(4), 1, (4,), (1,), False), "does not fit"
    yield "one stride too many", Call(rebuild, np.zeros(4), 0, (3, 2), (2, 1), False), "does not fit"
    repeated = Call(rebuild, np.zeros(4), 0, (1000,), (0,), False)
    yield "a view of a repeated number", Call(rebuild, repeated, 0, (1000,), (1,), False), "not where"
    yield "a function", np.load, "refused"
    yield "a function that we stand in for", encode, "is no data"
    yield "a class", OrderedDict, "is no data"
    yield "a function among other things", [{"b": (1, {encode: 2})}], "is no data"
    yield "a function in a set", {encode}, "is no data"
    yield "a function that is changed", Built(), "it changes '_latin1'"
    yield "a type of numpy's that is changed", Built(torch.FloatStorage), "it changes"
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
    (tmp_path / "a").write_bytes(pickled({"a": attack}))
    with pytest.raises(StageError) as caught:
        read_tool_file(tmp_path / "a", "a hint")
    assert words in caught.value.facts[0] and caught.value.hint == "a hint"
    assert holds(caught.value.problem, tmp_path / "a", "without running")


def test_a_tensor_that_just_fits_is_read(tmp_path):
    rebuild, numbers = torch._utils._rebuild_tensor_v2, np.arange(6.0)
    for offset, shape, stride, wanted in (
        (np.int64(2), (4,), (1,), [2, 3, 4, 5]),
        (1, (np.int64(2), 2), (np.int64(3), 1), [[1, 2], [4, 5]]),
        (5, (3,), (0,), [5, 5, 5]),
        (6, (0,), (1,), []),
    ):
        attack = Call(rebuild, numbers, offset, shape, stride, False, OrderedDict())
        (tmp_path / "a").write_bytes(pickle.dumps([attack], 2))
        np.testing.assert_array_equal(read_tool_file(tmp_path / "a")[0], wanted)


def test_what_an_ordered_dictionary_has_beside_its_entries_is_left_out(tmp_path):
    weights = torch.nn.Linear(2, 1).state_dict()
    assert weights._metadata
    torch.save(weights, tmp_path / "a")
    same(read_tool_file(tmp_path / "a"), dict(weights))


def bombs(folder):
    """Small files that would be large in memory, by name."""
    rebuild, load = torch._utils._rebuild_tensor_v2, torch.storage._load_from_bytes
    np.savez_compressed(folder / "packed.npz", a=np.zeros(1 << 21), b=np.zeros(1 << 21))
    (folder / "z.pkl").write_bytes(zlib.compress(pickle.dumps(np.zeros(1 << 22))))
    (folder / "strides.pkl").write_bytes(pickle.dumps(Call(rebuild, np.zeros(4), 0, (1 << 22,), (0,), False), 2))
    inner = io.BytesIO()
    np.savez_compressed(inner, a=np.zeros(1 << 20))
    (folder / "nested.pkl").write_bytes(pickle.dumps([Call(load, inner.getvalue()) for _ in range(5)], 2))
    return sorted(path.name for path in folder.iterdir())


def test_small_files_that_would_be_large_in_memory_are_refused(tmp_path, monkeypatch):
    names = bombs(tmp_path)
    assert len(names) == 4
    for name in names:
        monkeypatch.setattr(Budget.__init__, "__defaults__", (0, 1 << 26))
        read_tool_file(tmp_path / name)
        monkeypatch.setattr(Budget.__init__, "__defaults__", (0, 1 << 24))
        tracemalloc.start()
        with pytest.raises(StageError, match="too much memory") as caught:
            read_tool_file(tmp_path / name)
        assert "would take 0.0" in caught.value.facts[0] and "shorter clip" in caught.value.hint
        assert tracemalloc.get_traced_memory()[1] < 3 << 24, name
        tracemalloc.stop()


def test_a_storage_that_many_tensors_share_is_unpacked_once(tmp_path):
    base = torch.zeros(1 << 20)
    torch.save([base[i : i + 2] for i in range(200)], tmp_path / "a")
    tracemalloc.start()
    read_tool_file(tmp_path / "a")
    assert tracemalloc.get_traced_memory()[1] < 40 << 20
    tracemalloc.stop()


def test_an_archive_packed_by_other_methods_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros(3))
    with zipfile.ZipFile(tmp_path / "a.npz") as old, zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_LZMA) as new:
        new.writestr("a.npy", old.read("a.npy"))
    with pytest.raises(StageError) as caught:
        read_tool_file(tmp_path / "b.npz")
    assert "method 14" in caught.value.facts[0]


def test_a_value_that_holds_itself_is_refused(tmp_path):
    endless = []
    endless.append(endless)
    (tmp_path / "a").write_bytes(pickle.dumps(endless))
    with pytest.raises(StageError, match="cannot be read"):
        read_tool_file(tmp_path / "a")

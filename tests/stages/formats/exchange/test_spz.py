"""SPZ: how far what is read lies from what was written, files that lie about themselves, and what other programs make of it."""

import base64
import contextlib
import gzip
import json
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.avatar.body.rotations import angle_between, matrix_from_quat
from stages.avatar.splats.turn import OVER, turned
from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.exchange.glb import Glb
from stages.formats.exchange.ply import write_ply
from stages.formats.exchange.read import read_any_scene
from stages.formats.exchange.spz import HEAD, MAGIC, MORE, STEPS, read_spz, write_spz
from stages.records import Scene
from tests.made import judges
from tests.made.devtools import Page
from tests.made.said import holds
from tests.made.tiny import make_avatar

DOCUMENT = Path(__file__).parents[4] / "docs" / "exports.md"
PERSON = make_avatar(read_body_model())  # y up, facing z
COLUMNS = ("a.ply", "down.spz", "up.spz")
CONVERTERS = {"3.7.0": "@playcanvas/splat-transform", "2.7.1": "splat-transform-2"}
SPARK = """<!doctype html><script type="importmap">
{"imports": {"three": "ROOT/three/build/three.module.js", "three/addons/": "ROOT/three/examples/jsm/"}}
</script>
<script type="module">
import { SplatMesh } from "ROOT/@sparkjsdev/spark/dist/spark.module.min.js";
window.places = async (name, text) => {
  const fileBytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const mesh = new SplatMesh({ fileBytes, fileName: name });
  await mesh.initialized;
  const found = [];
  mesh.forEachSplat((i, center) => found.push(center.toArray()));
  return found;
};
window.ready = true;
</script>"""


def some(n: int = 2000, degree: int = 0, antialias: bool = False) -> Scene:
    rng = np.random.default_rng(0)
    parts = {
        "means": rng.normal(size=(n, 3)) * 5,
        "quats": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.uniform(-9, 1, (n, 3))),
        "opacities": rng.random(n),
        "sh0": rng.uniform(-1.77, 1.77, (n, 3)),
        "shN": rng.uniform(-0.9, 0.9, (n, (degree + 1) ** 2 - 1, 3)),
    }
    return Scene(**{name: part.astype(np.float32) for name, part in parts.items()}, antialias=antialias)


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    turns = (matrix_from_quat(torch.as_tensor(quats, dtype=torch.float64)) for quats in (a, b))
    return np.rad2deg(angle_between(*turns).numpy())


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", range(4))
def test_what_comes_back(tmp_path, degree, version, held):
    splats = some(degree=degree, antialias=degree == 2)
    assert write_spz(tmp_path / "a.spz", splats, version) == {}
    back = read_spz(tmp_path / "a.spz")
    away = np.linalg.norm(back.means - splats.means, axis=1)
    held(np.percentile(away, 99) * 1000, 0.2, "p99 of places, mm")
    held(np.percentile(np.abs(back.sh0 - splats.sh0), 99) * 0.2820948, 1 / 255, "p99 of colours")
    held(np.abs(back.opacities - splats.opacities).max(), 0.5 / 255 + 1e-6)
    held(np.abs(np.log(back.scales / splats.scales)).max(), 1 / 32 + 1e-4)
    held(np.percentile(apart(back.quats, splats.quats), 99), 0.2, "p99 of rotations, degrees")
    if degree:
        held(np.abs(back.shN[:, :3] - splats.shN[:, :3]).max(), 4.6 / 128)
        held(np.abs(back.shN - splats.shN).max(), 8.6 / 128)
    assert back.antialias == splats.antialias and back.shN.shape == splats.shN.shape


def test_the_same_gaussians_make_the_same_bytes(tmp_path):
    for name in ("a.spz", "b.spz"):
        write_spz(tmp_path / name, some(degree=1))
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_singular_gaussians(tmp_path):
    """Half turns, equal components, scales under a nanometre, none at all."""
    splats = some(6)
    splats.quats[:4] = [[0, 1, 0, 0], [1, 1, 1, 1], [-1, 0, 0, 0], [0.5, -0.5, 0.5, -0.5]]
    splats.scales[:2] = 6e-11
    write_spz(tmp_path / "a.spz", splats)
    back = read_spz(tmp_path / "a.spz")
    assert apart(back.quats, splats.quats).max() < 0.3
    np.testing.assert_allclose(back.scales[:2], np.exp(-10), rtol=1e-6)
    write_spz(tmp_path / "none.spz", some(0))
    assert len(read_spz(tmp_path / "none.spz")) == 0


def test_what_is_clamped_is_counted(tmp_path):
    splats = some(5, degree=1)
    splats.means[2, 1], splats.sh0[3, 0], splats.sh0[3, 1] = -5000, 4, -4
    splats.scales[:2, 1], splats.shN[1, 2, 0], splats.shN[4, 0, 1], splats.shN[4, 1, 1] = 900, 3, -2, 2
    said = write_spz(tmp_path / "a.spz", splats)
    lines = [f"{count} {what}" for what, count in said.items()]
    facts = (1, "2048 m"), (2, "379 m"), (1, "colours"), (2, "colours", "view")
    assert len(lines) == 4 and all(holds(line, *one) for line, one in zip(lines, facts, strict=True))
    back = read_spz(tmp_path / "a.spz")
    assert back.means[2, 1] == -2048 and round(float(back.scales[0, 1])) == 379
    assert back.shN[1, 2, 0] == 127 / 128 and back.shN[4, 0, 1] == -1


def test_version_2_is_read(tmp_path):
    turn = np.array([[0.5, 0.5, -0.5, 0.5], [1, 0, 0, 0]])
    xyz = np.rint(turn[:, 1:] * 127.5 + 127.5).astype(np.uint8)
    tables = [
        bytes([0, 16, 0, 0, 240, 255, 1, 0, 0] * 2),
        b"\xff\x00",
        bytes([166] * 6),
        bytes([160] * 6),
        xyz.tobytes(),
    ]
    (tmp_path / "a.spz").write_bytes(gzip.compress(HEAD.pack(MAGIC, 2, 2, 0, 12, 1, 0) + b"".join(tables)))
    back = read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(back.means[0], [1, -1, 1 / 4096], atol=1e-9)
    assert apart(back.quats, turn).max() < 1 and back.antialias
    np.testing.assert_allclose(back.sh0, (166 / 255 - 0.5) / 0.15, rtol=1e-6)
    assert back.opacities.tolist() == [1, 0] and np.allclose(back.scales, 1)


def test_a_table_of_version_4_that_unpacks_to_more_than_it_may_is_refused(tmp_path):
    """64 MiB of zeros in a few bytes."""
    from backports import zstd

    write_spz(tmp_path / "a.spz", some(5), version=4)
    data = (tmp_path / "a.spz").read_bytes()
    bomb = zstd.compress(bytes(1 << 26))
    start = 32 + 5 * 16
    packed = struct.unpack_from("<Q", data, 32)[0]
    bombed = data[:32] + struct.pack("<Q", len(bomb)) + data[40:start] + bomb + data[start + packed :]
    (tmp_path / "a.spz").write_bytes(bombed)
    tracemalloc.start()
    with pytest.raises(StageError, match="cut short or damaged"):
        read_spz(tmp_path / "a.spz")
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_version_4_cut_anywhere_is_refused(tmp_path):
    write_spz(tmp_path / "a.spz", some(5, 1), version=4)
    data = (tmp_path / "a.spz").read_bytes()
    for end in range(4, len(data)):
        (tmp_path / "b.spz").write_bytes(data[:end])
        with pytest.raises(StageError, match=r"b\.spz"):
            read_spz(tmp_path / "b.spz")


def packed(*head: int, body: bytes = b"", magic: bytes = MAGIC) -> bytes:
    return gzip.compress(HEAD.pack(magic, *head, 0) + body, mtime=0)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "no SPZ"),
        (b"ply\n", "cannot read"),
        (HEAD.pack(MAGIC, 5, 1, 0, 12, 0, 5) + bytes(40), "version 5"),
        (HEAD.pack(MAGIC, 4, 1, 0, 12, 0, 5) + struct.pack("<I12x", 32) + b"\xff" * 80, "cut short"),
        (packed(4, 1, 0, 12, 0), "version 4"),
        (gzip.compress(b"NGS", mtime=0), "no SPZ"),
        (packed(3, 1, 0, 12, 0, magic=b"NGSQ"), "no SPZ"),
        (packed(1, 1, 0, 12, 0), "version 1"),
        (packed(3, 1, 4, 12, 0), "degree 4"),
        (packed(3, 1, 0, 60, 0), "60 bits"),
        (packed(3, 2, 0, 12, 0, body=bytes(39)), "2 x 4 bytes"),
        (packed(3, 2, 0, 12, 0, body=bytes(41)), "longer"),
        (packed(3, 2, 0, 12, 0, body=bytes(40))[:-12], "cut short"),
        (packed(3, 2**32 - 1, 3, 12, 0), "too much memory"),
    ],
)
def test_files_that_lie_are_refused_by_name(tmp_path, data, said):
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(StageError) as refused:
        read_spz(tmp_path / "a.spz")
    assert said in f"{refused.value} {' '.join(refused.value.facts)}" and "a.spz" in str(refused.value)


def test_memory_does_not_grow_with_the_file(tmp_path, held):
    peaks = []
    for n in (100_000, 200_000):
        splats = some(n)
        tracemalloc.start()
        write_spz(tmp_path / "a.spz", splats)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    held((peaks[1] - peaks[0]) / 100_000, 30, "bytes a Gaussian of 56")


def test_higher_colours_are_multiples_of_a_step_and_so_pack_well(tmp_path):
    splats = some(300, degree=3)
    write_spz(tmp_path / "a.spz", splats)
    whole = np.rint(read_spz(tmp_path / "a.spz").shN * 128) + 128
    for part, step in ((whole[:, :3], STEPS[0]), (whole[:, 3:], STEPS[1])):
        assert (part % step == 0)[part < 255].all() and len(np.unique(part)) > 5


@pytest.mark.parametrize("value", [1.2, -1.2])
def test_colours_that_depend_too_much_on_the_view_are_counted_whichever_way(tmp_path, value):
    splats = some(9, degree=1)
    splats.shN[3, 1, 2] = value
    ((what, count),) = write_spz(tmp_path / "a.spz", splats).items()
    assert count == 1 and holds(what, "colours", "view")


def test_what_extensions_add_after_the_tables_is_left(tmp_path):
    write_spz(tmp_path / "a.spz", some(5))
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(data) + b"more"))
    with pytest.raises(StageError, match=r"b\.spz.*longer"):
        read_spz(tmp_path / "b.spz")
    data[HEAD.size - 2] |= MORE
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(data) + b"more"))
    assert np.array_equal(read_spz(tmp_path / "b.spz").means, read_spz(tmp_path / "a.spz").means)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("axes")
    down = turned(PERSON, OVER)
    write_ply(folder / "a.ply", down)
    write_spz(folder / "down.spz", down)
    write_spz(folder / "up.spz", turned(down, OVER))
    write_spz(folder / "four.spz", down, version=4)
    return folder


def stands(places):
    """How a program with y up shows the person, from its Gaussians in our order; AssertionError unless they were turned only."""
    for up, ahead in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        if np.abs(np.asarray(places) * [up * ahead, up, ahead] - PERSON.means).max() < 2e-3:
            return f"{'upright' if up > 0 else 'upside down'}, faces {'' if ahead > 0 else '-'}z"
    raise AssertionError("they are not as they were, but for turns")


def converted(name, path, to):
    """A file as a version of splat-transform writes it."""
    judges.node(judges.modules() / name / "bin" / "cli.mjs", "-q", "-w", path, to)
    return to


def in_splat_transform(version, path, tmp_path):
    """From its .glb, whose y is up by the standard."""
    glb = Glb(converted(CONVERTERS[version], path, tmp_path / f"{path.name}.glb"))
    return glb.array(glb.content["meshes"][0]["primitives"][0]["attributes"]["POSITION"], "<f4", 3)


def written(row):
    """The row of a program in the table of the documents."""
    lines = [line for line in DOCUMENT.read_text().splitlines() if line.startswith(f"| {row} |")]
    return [cell.strip() for cell in lines[0].split("|")[2:-1]]


@pytest.mark.slow
@pytest.mark.parametrize("version", CONVERTERS)
def test_splat_transform(files, tmp_path, version):
    found = [stands(in_splat_transform(version, files / name, tmp_path)) for name in COLUMNS]
    assert written(f"splat-transform {version}") == found


@pytest.mark.slow
def test_spark(files, tmp_path):
    page = tmp_path / "spark.html"
    page.write_text(SPARK.replace("ROOT", judges.modules().as_uri()))
    flags = ["--disable-gpu", "--allow-file-access-from-files"]
    with contextlib.closing(Page(tmp_path / "profile", flags=flags)) as tab:
        tab.open(page, "window.ready === true", 30)
        text = {name: base64.b64encode((files / name).read_bytes()).decode() for name in (*COLUMNS, "four.spz")}
        places = [tab.run(f"places({json.dumps(name)}, {json.dumps(text[name])})") for name in COLUMNS]
        assert written(f"Spark {judges.PACKAGES['@sparkjsdev/spark']}") == [stands(one) for one in places]
        with pytest.raises(RuntimeError):  # therefore version 3 is written
            tab.run(f"places('four.spz', {json.dumps(text['four.spz'])})")


@pytest.mark.slow
def test_there_and_back_through_splat_transform(files, tmp_path, held):
    """The same Gaussians, within the precision of .spz; its own are of version 4."""
    ours = read_any_scene(files / "a.ply")
    for name in ("down.spz", "four.spz"):
        back = converted(CONVERTERS["3.7.0"], files / name, tmp_path / name)
        assert back.read_bytes()[:5] == b"NGSP\4"
        theirs = read_any_scene(back)
        held(1000 * np.abs(theirs.means - ours.means).max(), 0.3, "mm")
        held(np.abs(theirs.sh0 - ours.sh0).max() * 0.2820948, 1 / 255)
        held(np.abs(theirs.opacities - ours.opacities).max(), 1 / 255)
        held(np.abs(np.log(theirs.scales / ours.scales)).max(), 1 / 16)
    upright = read_any_scene(converted(CONVERTERS["2.7.1"], files / "up.spz", tmp_path / "b.ply"))
    held(1000 * np.abs(upright.means - ours.means).max(), 0.3, "mm of 2.7.1, from a file whose y is up")

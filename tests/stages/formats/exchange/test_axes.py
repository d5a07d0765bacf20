"""Which way up our files stand in the programs of today, by where these put the Gaussians; docs/exports.md has the table."""

import base64
import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

from stages.avatar.splats.turn import OVER, turned
from stages.formats.body_model import read_body_model
from stages.formats.exchange.glb import Glb
from stages.formats.exchange.ply import write_ply
from stages.formats.exchange.read import read_any_scene
from stages.formats.exchange.spz import write_spz
from tests.made import judges
from tests.made.devtools import Page
from tests.made.tiny import make_avatar

pytestmark = pytest.mark.slow
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
            return f"{'upright' if up > 0 else 'on the head'}, faces {'' if ahead > 0 else '-'}z"
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


@pytest.mark.parametrize("version", CONVERTERS)
def test_splat_transform(files, tmp_path, version):
    found = [stands(in_splat_transform(version, files / name, tmp_path)) for name in COLUMNS]
    assert written(f"splat-transform {version}") == found


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

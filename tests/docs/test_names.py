"""Unity's humanoid map in docs/exports.md: its names are those of one joint in files of all four naming schemes."""

import re
from typing import get_args

import pytest

from stages.avatar.drawing.rig import rig_of
from stages.formats.body_model import read_body_model
from stages.formats.exchange.avatar_glb import write_avatar_glb
from stages.formats.exchange.bone_names import Names
from stages.formats.exchange.glb import Glb
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES
from tests.docs.documents import ROOT
from tests.made.meshes import body_mesh, handed_avatar


def row(cells: list[str]) -> list[tuple[str, ...]]:
    """The joints of a row, each by its names in the order of Names: VRM's are Unity's, written otherwise."""
    unity, smpl, mixamo, unreal = (cell.strip().split(", ") for cell in cells)
    vrm = [(name[0].lower() + name[1:]).replace(" ", "") for name in unity]
    return list(zip(smpl, [f"mixamorig:{name}" for name in mixamo], vrm, unreal, strict=True))


def right(name: str) -> str:
    """Of the joint on the other side."""
    return re.sub(r"_l$", "_r", name.replace("Left", "Right").replace("left", "right"))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Scheme -> names of the joints of an avatar with fingers, as its avatar.glb has them."""
    model, folder, found = read_body_model(), tmp_path_factory.mktemp("names"), {}
    rig = rig_of(handed_avatar(model))
    for names in get_args(Names):
        write_avatar_glb(folder / f"{names}.glb", rig, body_mesh(model), [], names)
        content = Glb(folder / f"{names}.glb").content
        found[names] = [content["nodes"][joint]["name"] for joint in content["skins"][0]["joints"]]
    return found


def test_each_joint_of_unitys_map_has_its_names_in_the_files(written):
    text = (ROOT / "docs" / "exports.md").read_text()
    table = re.search(r"^\| Unity \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE)[1]
    rows = [joint for line in table.splitlines() for joint in row(line.strip("|").split("|"))]
    rows = list(dict.fromkeys([*rows, *(tuple(map(right, joint)) for joint in rows)]))
    places = [
        {written[names].index(name) for names, name in zip(get_args(Names), joint, strict=True)} for joint in rows
    ]
    assert [joint for joint, place in zip(rows, places, strict=True) if len(place) > 1] == []
    palms = {f"{side}_hand" for side in ("left", "right")}
    fingers = {name for name in FINGER_NAMES if name.endswith("middle1")}
    assert {smpl for smpl, *_ in rows} == set(JOINT_NAMES) - palms | fingers

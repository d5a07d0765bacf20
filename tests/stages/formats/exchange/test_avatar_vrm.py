"""avatar.vrm: what @pixiv/three-vrm makes of it, and the validator of Khronos."""

import base64
import contextlib

import numpy as np
import pytest

from stages.avatar.drawing.rig import rig_of
from stages.formats.body_model import read_body_model
from stages.formats.exchange.avatar_vrm import write_avatar_vrm
from stages.formats.exchange.bone_names import bone_names, finger_names
from stages.formats.exchange.glb import Glb
from stages.formats.exchange.vrm_meta import LICENCE, VrmMeta
from stages.records import JOINT_NAMES
from tests.made import judges
from tests.made.clothes import dress, some_clothes
from tests.made.devtools import SOFTWARE, Page
from tests.made.meshes import EYE, body_mesh, handed_avatar, handed_mesh
from tests.made.tiny import make_avatar

MODEL = read_body_model()
FLOOR = float(body_mesh(MODEL).vertices[:, 1].min())  # m
SIDED = "UpperLeg LowerLeg Foot UpperArm LowerArm Hand".split()
REQUIRED = {"hips", "spine", "head"} | {f"{side}{part}" for side in ("left", "right") for part in SIDED}
PAGE = """<!doctype html><script type="importmap">
{"imports": {"three": "ROOT/three/build/three.module.js", "three/addons/": "ROOT/three/examples/jsm/"}}
</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { VRMLoaderPlugin } from "ROOT/@pixiv/three-vrm/lib/three-vrm.module.min.js";
const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
const bytes = await (await fetch("data:model/gltf-binary;base64,DATA")).arrayBuffer();
const vrm = (await loader.parseAsync(bytes, "")).userData.vrm;
window.where = () => {
  vrm.scene.updateMatrixWorld(true);
  return Object.fromEntries(Object.entries(vrm.humanoid.humanBones).map(([name, bone]) =>
    [name, new THREE.Vector3().setFromMatrixPosition(bone.node.matrixWorld).toArray()]));
};
window.raise = (name, angle) => {
  vrm.humanoid.getNormalizedBoneNode(name).rotation.z = angle;
  vrm.update(0);
  return window.where();
};
window.said = (name, share) => {
  vrm.expressionManager.setValue(name, share);
  vrm.update(0);
  let found = [];
  vrm.scene.traverse((one) => { if (one.isSkinnedMesh) found = one.morphTargetInfluences; });
  return found;
};
window.gaze = () => vrm.lookAt.getLookAtWorldPosition(new THREE.Vector3()).toArray();
window.look = (place) => {
  vrm.lookAt.lookAt(new THREE.Vector3(...place));
  vrm.update(0);
  let found = [];
  vrm.scene.traverse((one) => { if (one.isSkinnedMesh) found = one.morphTargetInfluences; });
  return found;
};
window.about = () => ({ meta: vrm.meta, box: new THREE.Box3().setFromObject(vrm.scene) });
window.ready = true;
</script>"""


@pytest.fixture(scope="module")
def rig():
    return rig_of(dress(make_avatar(MODEL, every=20), some_clothes()))


@pytest.fixture(scope="module")
def file(rig, tmp_path_factory):
    path = tmp_path_factory.mktemp("vrm") / "avatar.vrm"
    meta = VrmMeta(name="Ann", authors=("Ann", "Bo"), avatar_permission="everyone", copyright_information="2026 Ann")
    write_avatar_vrm(path, rig, body_mesh(MODEL), meta, "vrm", FLOOR)
    return path


def test_all_bones_of_a_person_are_named_once(file):
    content = Glb(file).content
    about = content["extensions"]["VRMC_vrm"]
    bones = {name: content["nodes"][one["node"]]["name"] for name, one in about["humanoid"]["humanBones"].items()}
    assert set(bones) >= REQUIRED and all(name == node for name, node in bones.items()) and len(bones) == 24
    assert about["specVersion"] == "1.0" and content["extensionsUsed"] == ["VRMC_vrm"] and "animations" not in content


def test_what_may_be_done_with_it_is_as_it_was_given_and_else_the_least(file):
    meta = Glb(file).content["extensions"]["VRMC_vrm"]["meta"]
    assert meta["name"] == "Ann" and meta["authors"] == ["Ann", "Bo"] and meta["licenseUrl"] == LICENCE
    assert meta["avatarPermission"] == "everyone" and meta["copyrightInformation"] == "2026 Ann"
    assert meta["modification"] == "prohibited" and meta["commercialUsage"] == "personalNonProfit"
    assert meta["creditNotation"] == "required" and "contactInformation" not in meta
    assert [value for name, value in meta.items() if name.startswith("allow")] == [False] * 5


def test_other_names_of_nodes_leave_the_bones_as_they_are(rig, tmp_path):
    write_avatar_vrm(tmp_path / "a.vrm", rig, body_mesh(MODEL), VrmMeta(), "mixamo")
    content = Glb(tmp_path / "a.vrm").content
    hips = content["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]["hips"]["node"]
    assert content["nodes"][hips]["name"] == "mixamorig:Hips"


@pytest.mark.slow
def test_the_validator_of_khronos_complains_of_nothing(file):
    assert judges.faults(file) == []


@contextlib.contextmanager
def opened(file, folder):
    """A VRM in three-vrm, in a tab of its own."""
    page = folder / "vrm.html"
    text = PAGE.replace("ROOT", judges.modules().as_uri())
    page.write_text(text.replace("DATA", base64.b64encode(file.read_bytes()).decode()))
    with contextlib.closing(Page(folder / "profile", flags=[*SOFTWARE, "--allow-file-access-from-files"])) as tab:
        tab.open(page, "window.ready === true", 30)
        yield tab


@pytest.mark.slow
def test_three_vrm_finds_fingers_that_turn_and_a_mouth_that_opens(tmp_path):
    (mesh, _), rig = handed_mesh(MODEL), rig_of(handed_avatar(MODEL))
    write_avatar_vrm(tmp_path / "a.vrm", rig, mesh, VrmMeta(), "mixamo", FLOOR)
    with opened(tmp_path / "a.vrm", tmp_path) as tab:
        rest, bent = tab.run("where()"), tab.run(f"raise('leftIndexProximal', {np.pi / 2})")
        shut, wide = tab.run("said('aa', 0)"), tab.run("said('aa', 1)")
    for bone, place in zip(finger_names("vrm"), rig.finger_joints, strict=False):
        np.testing.assert_allclose(rest[bone], place - [0, FLOOR, 0], atol=1e-5, err_msg=f"{bone}, m")
    moved = {bone for bone in rest if np.linalg.norm(np.subtract(bent[bone], rest[bone])) > 1e-4}
    assert moved == {"leftIndexIntermediate", "leftIndexDistal"}
    names = Glb(tmp_path / "a.vrm").content["meshes"][0]["extras"]["targetNames"]
    assert [name for name, share in zip(names, wide, strict=True) if share] == ["jawOpen"] and not any(shut)


@pytest.mark.slow
def test_three_vrm_lets_eyes_follow_a_point(tmp_path):
    (mesh, _), rig = handed_mesh(MODEL), rig_of(handed_avatar(MODEL))
    write_avatar_vrm(tmp_path / "a.vrm", rig, mesh, VrmMeta(), "vrm", FLOOR)
    names = Glb(tmp_path / "a.vrm").content["meshes"][0]["extras"]["targetNames"]
    ways = {
        (0.5, 0): "OutLeft InRight",
        (-0.5, 0): "InLeft OutRight",
        (0, 0.5): "UpLeft UpRight",
        (0, -0.5): "DownLeft DownRight",
    }
    with opened(tmp_path / "a.vrm", tmp_path) as tab:
        eyes = np.array(tab.run("gaze()"))
        np.testing.assert_allclose(eyes, EYE * [0, 1, 1] - [0, FLOOR, 0], atol=0.01)
        for (x, y), wanted in ways.items():
            shares = tab.run(f"look({(eyes + [x, y, 1]).tolist()})")
            shown = {
                name.removeprefix("eyeLook"): share for name, share in zip(names, shares, strict=True) if share > 0.02
            }
            assert shown == dict.fromkeys(wanted.split(), 1), f"{x, y}"
        half = dict(zip(names, tab.run(f"look({(eyes + [np.tan(np.radians(7)), 0, 1]).tolist()})"), strict=True))
    assert half["eyeLookOutLeft"] == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
def test_three_vrm_opens_it_and_poses_its_bones(file, rig, tmp_path):
    with opened(file, tmp_path) as tab:
        about, rest = tab.run("about()"), tab.run("where()")
        raised = tab.run(f"raise('leftUpperArm', {np.pi / 2})")
    assert about["meta"]["authors"] == ["Ann", "Bo"] and about["meta"]["metaVersion"] == "1"
    expected = rig.joints - [0, FLOOR, 0]
    for joint, bone in enumerate(bone_names("vrm")):
        np.testing.assert_allclose(rest[bone], expected[joint], atol=1e-5, err_msg=f"{bone}, m, in the T-pose")
    assert about["box"]["max"]["y"] > 1.4 and abs(about["box"]["min"]["y"]) < 1e-3, "m"
    shoulder, hand = (np.array(raised[f"left{part}"]) for part in ("UpperArm", "Hand"))
    reach = np.linalg.norm(expected[JOINT_NAMES.index("left_wrist")] - expected[JOINT_NAMES.index("left_shoulder")])
    assert hand[1] - shoulder[1] > 0.95 * reach, "the left arm, along x, goes up"
    assert raised["rightHand"] == pytest.approx(rest["rightHand"])

"""avatar.glb: one textured mesh on a skeleton that other programs skin, pose and open as we do."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.skinning import all_bones, skin
from stages.avatar.drawing.avatar import bones_of, load_avatar
from stages.avatar.drawing.rig import rig_of
from stages.avatar.drawing.takes import _poses, hung
from stages.avatar.motion.takes import made_takes
from stages.avatar.rasterize import Camera
from stages.formats.body_model import read_body_model
from stages.formats.exchange.avatar_glb import start, surface, write_avatar_glb
from stages.formats.exchange.avatar_vrm import write_avatar_vrm
from stages.formats.exchange.bone_names import bone_names
from stages.formats.exchange.glb import Arrays, Glb
from stages.formats.exchange.vrm_meta import VrmMeta
from stages.gestures import FACE_NAMES
from tests.made import judges
from tests.made.clothes import dress, some_clothes
from tests.made.gltf import TYPES, array, skinned
from tests.made.meshes import body_mesh, handed_avatar, handed_mesh
from tests.made.three_page import opened
from tests.made.tiny import make_avatar

MODEL = read_body_model()
JAW = FACE_NAMES.index("jawOpen")
FLOOR = -1.2  # m: where the T-pose's soles are


@pytest.fixture(scope="module")
def avatar():
    return dress(make_avatar(MODEL, every=20), some_clothes())


@pytest.fixture(scope="module")
def mesh(avatar):
    """The body's, of which every fifth vertex hangs on a bone of clothes."""
    made = body_mesh(MODEL)
    made.bones[::5, 0] = 24 + np.arange(len(made.bones[::5])) % len(avatar.clothes)
    return made


@pytest.fixture(scope="module")
def take(avatar):
    return hung(load_avatar(avatar), made_takes(avatar.joints[0])[0])


@pytest.fixture(scope="module")
def file(avatar, mesh, take, tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "avatar.glb"
    write_avatar_glb(path, rig_of(avatar), mesh, [take], "smpl", FLOOR)
    return path


def ours(avatar, mesh, take, pose):
    """Where we put the mesh, [V,3]: bones of clothes are made rigid, as engines have them."""
    baked = load_avatar(avatar)
    orient, body_pose, step = (part[pose] for part in _poses(baked, take))
    bones = bones_of(baked, orient, body_pose).double()
    joints, hang_on = bones[:24], avatar.clothes.hang_on
    for k, (turn, place) in enumerate(zip(take.clothes[pose][:, :4], take.clothes[pose][:, 4:])):
        above = joints[hang_on[k]]
        start = above[:3, :3] @ torch.as_tensor(avatar.joints[hang_on[k]]).double() + above[:3, 3]
        turned = above[:3, :3] @ torch.as_tensor(Rotation.from_quat(turn, scalar_first=True).as_matrix())
        bones[24 + k, :3, :3] = turned
        centre = torch.as_tensor(avatar.clothes.centres[k]).double()
        bones[24 + k, :3, 3] = start + above[:3, :3] @ torch.as_tensor(place).double() - turned @ centre
    weights = torch.as_tensor(all_bones(mesh.bones, mesh.weights, len(bones)))
    return (skin(torch.as_tensor(mesh.vertices).double(), weights, bones)[0] + step).numpy()


@pytest.mark.parametrize("pose", [0, 25, 60])
def test_a_program_that_skins_by_the_file_puts_the_mesh_where_we_do(avatar, mesh, take, file, pose):
    there = ours(avatar, mesh, take, pose)
    assert np.linalg.norm(there - mesh.vertices, axis=1).max() > 0.3 or pose == 0, "it moves"
    assert np.linalg.norm(skinned(Glb(file), pose) + [0, FLOOR, 0] - there, axis=1).max() < 1e-4


def test_it_holds_a_mesh_and_nothing_that_programs_do_not_know(file):
    content = Glb(file).content
    assert [one["name"] for one in content["meshes"]] == ["body"] and len(content["meshes"][0]["primitives"]) == 1
    assert "extensionsUsed" not in content and "extras" not in content
    assert content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}


def test_the_texture_is_the_meshs(mesh, file):
    glb = Glb(file)
    (image,) = glb.content["images"]
    view = glb.content["bufferViews"][image["bufferView"]]
    packed = np.frombuffer(glb.data, np.uint8, view["byteLength"], view["byteOffset"])
    back = cv2.imdecode(packed, cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    assert back.shape == mesh.texture.shape and np.abs(back - mesh.texture).max() < 20
    uvs = array(glb, glb.content["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"])
    np.testing.assert_array_equal(uvs, mesh.uvs)


def test_the_same_avatar_makes_the_same_bytes(avatar, mesh, take, file, tmp_path):
    write_avatar_glb(tmp_path / "again.glb", rig_of(avatar), mesh, [take], "smpl", FLOOR)
    assert (tmp_path / "again.glb").read_bytes() == file.read_bytes()


@pytest.mark.parametrize(("count", "kind"), [(300, 5123), ((1 << 16) - 1, 5123), (1 << 16, 5125), (70_000, 5125)])
def test_a_mesh_of_many_vertices_has_wider_indices(mesh, count, kind):
    rows, arrays = np.zeros((count, 3)), Arrays()
    four = {"bones": np.zeros((count, 4), np.uint8), "weights": np.zeros((count, 4), np.uint16)}
    faces = np.array([[0, 1, count - 1]])
    many = replace(mesh, vertices=rows, normals=rows, faces=faces, uvs=rows[:, :2], **four)
    made = arrays.accessors[surface(start("a"), many, arrays)["indices"]]
    assert made["componentType"] == kind
    view = arrays.views[made["bufferView"]]
    assert np.frombuffer(arrays.data, TYPES[kind], 3, view["byteOffset"])[2] == count - 1


@pytest.mark.slow
def test_the_validator_of_khronos_complains_of_nothing(file):
    assert judges.faults(file) == []


@pytest.mark.slow
def test_three_js_draws_the_textured_mesh_as_it_is_posed(file, tmp_path):
    """Red above, blue below, both arms up or down."""
    view = np.diag([1.0, -1, -1, 1])
    view[:3, 3] = [0, 1.0, 4]
    camera = Camera.of(view, np.array([[200.0, 0, 80], [0, 200, 100], [0, 0, 1]]), 160, 200)
    with opened(file, tmp_path) as page:
        assert page.found["skinned"] == 1 and page.found["map"] == 8 and page.found["seconds"] < 5
        pictures = [page.picture("jumping_jacks", seconds, camera) for seconds in (0.0, 0.5)]
    for picture in pictures:
        rows = np.flatnonzero(picture[..., 3].any(1))
        head, feet = (picture[rows[k] : rows[k] + 12][picture[rows[k] : rows[k] + 12, :, 3] == 1] for k in (4, -14))
        assert head[:, 0].mean() > 0.6 > 0.2 > head[:, 2].mean() and feet[:, 2].mean() > 0.6 > 0.2 > feet[:, 0].mean()
    assert np.abs(pictures[0][..., 3] - pictures[1][..., 3]).sum() > 500, "it moves"


@pytest.mark.slow
def test_blender_poses_the_mesh_as_we_do_and_its_bones_lie_along_the_limbs(tmp_path, held):
    avatar, mesh = make_avatar(MODEL), body_mesh(MODEL)
    rig, truth = rig_of(avatar), {}
    takes, pose, baked = made_takes(rig.joints[0]), 60, load_avatar(avatar)
    write_avatar_glb(tmp_path / "a.glb", rig, mesh, takes)
    weights = torch.as_tensor(all_bones(mesh.bones, mesh.weights, 24)).float()
    for take in takes:
        orient, body_pose, step = (part[pose] for part in _poses(baked, take))
        truth[f"{take.name}_frame"] = np.array(pose)
        there, _ = skin(torch.as_tensor(mesh.vertices), weights, bones_of(baked, orient, body_pose))
        truth[f"{take.name}_body"] = (there + step).numpy()
    np.savez(tmp_path / "truth.npz", **truth)
    found = judges.blender("in_blender.py", tmp_path / "a.glb", tmp_path / "truth.npz")
    assert set(found["motions"]) == {take.name for take in takes}
    assert set(found["bones"]) == set(bone_names("smpl"))
    for name, away in found["motions"].items():
        held(away["body"][1], 1.5, f"largest distance of a vertex in {name}, mm")
    arm = np.array(found["bones"]["left_elbow"])
    assert arm @ [1, 0, 0] > 0.9, "towards the hand"


@pytest.fixture(scope="module")
def handed(tmp_path_factory):
    """The body's mesh on finger bones, with shapes of jaw and eyes: as files, and its vertices' weights for them."""
    (mesh, weights), record = handed_mesh(MODEL), handed_avatar(MODEL)
    path = tmp_path_factory.mktemp("hands")
    write_avatar_glb(path / "avatar.glb", rig_of(record), mesh, made_takes(record.joints[0])[:1], "vrm", FLOOR)
    write_avatar_vrm(path / "avatar.vrm", rig_of(record), mesh, VrmMeta(), "mixamo", FLOOR)
    return path, mesh, weights


def test_a_finger_bone_that_is_turned_moves_its_finger_alone(handed):
    path, mesh, weights = handed
    glb = Glb(path / "avatar.glb")
    rest = skinned(glb, None)
    assert np.linalg.norm(rest + [0, FLOOR, 0] - mesh.vertices, axis=1).max() < 1e-4
    nodes = {node["name"]: node for node in glb.content["nodes"]}
    turn = Rotation.from_quat(nodes["leftIndexProximal"]["rotation"]) * Rotation.from_euler("x", 60, degrees=True)
    nodes["leftIndexProximal"]["rotation"] = turn.as_quat().tolist()
    far = np.linalg.norm(skinned(glb, None) - rest, axis=1)
    index = weights[:, 24 + np.arange(3)].sum(1)
    assert far[index == 0].max() < 1e-6 and far[index > 0.99].min() > 1e-3 and far.max() > 0.05
    assert "leftMiddleProximal" in nodes and "leftPalm" in nodes and "rightThumbMetacarpal" in nodes


def test_shapes_of_the_face_are_morph_targets_by_name(handed):
    path, mesh, _ = handed
    content = Glb(path / "avatar.glb").content
    (one,) = content["meshes"]
    (primitive,) = one["primitives"]
    names = one["extras"]["targetNames"]
    assert names == list(FACE_NAMES) and len(primitive["targets"]) == len(one["weights"]) == 52
    jaw, up, brow = (
        content["accessors"][primitive["targets"][names.index(k)]["POSITION"]]
        for k in ("jawOpen", "eyeLookUpLeft", "browInnerUp")
    )
    assert jaw["count"] == len(mesh.vertices) and jaw["sparse"]["count"] == 40 and jaw["min"][1] == pytest.approx(-0.03)
    assert up["sparse"]["count"] == 9 and up["max"][1] == pytest.approx(0.003)
    assert brow["sparse"]["count"] == 1 and brow["min"] == brow["max"] == [0, 0, 0]


def test_a_bodys_own_expressions_are_targets_and_expressions_too(handed, tmp_path):
    _, mesh, _ = handed
    rig = rig_of(handed_avatar(MODEL))
    more = replace(mesh, morphs=np.concatenate([mesh.morphs, 0 * mesh.morphs[:1], mesh.morphs[[JAW]]]))
    write_avatar_vrm(tmp_path / "avatar.vrm", rig, more, VrmMeta(), "vrm")
    content = Glb(tmp_path / "avatar.vrm").content
    names, about = content["meshes"][0]["extras"]["targetNames"], content["extensions"]["VRMC_vrm"]["expressions"]
    assert names[-1] == "expression2" and len(names) == len(content["meshes"][0]["primitives"][0]["targets"]) == 53
    (bind,) = about["custom"]["expression2"]["morphTargetBinds"]
    assert bind["index"] == 52 and set(about["custom"]) == set(names)


def test_a_vrm_has_fingers_and_expressions(handed):
    content = Glb(handed[0] / "avatar.vrm").content
    about = content["extensions"]["VRMC_vrm"]
    bones = {bone: content["nodes"][one["node"]]["name"] for bone, one in about["humanoid"]["humanBones"].items()}
    assert (
        bones["leftMiddleProximal"] == "mixamorig:LeftHandMiddle1"
        and bones["rightLittleDistal"] == "mixamorig:RightHandPinky3"
    )
    assert len(bones) == len(set(bones.values())) == 24 - 2 + 30
    (said,) = about["expressions"]["preset"]["aa"]["morphTargetBinds"]
    names = content["meshes"][0]["extras"]["targetNames"]
    assert names[said["index"]] == "jawOpen" and content["nodes"][said["node"]]["mesh"] == 0
    assert set(about["expressions"]["custom"]) == set(names)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["avatar.glb", "avatar.vrm"])
def test_the_validator_of_khronos_complains_of_no_finger_and_no_face(handed, name):
    assert judges.faults(handed[0] / name) == []

"""avatar_splats.glb: what is written comes back, skins as we do, and files that lie are refused by name."""

import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.drawing.attach import attach
from stages.avatar.drawing.avatar import PosedAvatar, bones_of, load_avatar
from stages.avatar.drawing.rig import rig_of
from stages.avatar.drawing.takes import _poses, hung
from stages.avatar.motion.takes import made_takes
from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.exchange.avatar_glb import write_avatar_glb
from stages.formats.exchange.bone_names import bone_names
from stages.formats.exchange.glb import Arrays, Glb, write_glb
from stages.formats.exchange.splats_glb import SPLATS, _linear, read_avatar_glb, write_splats_glb
from stages.formats.hands_face import read_hands_face
from tests.made.clothes import dress, some_clothes
from tests.made.gltf import array, skinned, world_of
from tests.made.learned import pose_avatar
from tests.made.meshes import body_mesh
from tests.made.said import holds
from tests.made.tiny import make_avatar

MODEL = read_body_model()
FLOOR = -1.2  # m: where the T-pose's soles are


@pytest.fixture(scope="module")
def avatar():
    plain, rng = make_avatar(MODEL, every=20), np.random.default_rng(0)
    n = len(plain)
    weights = 0.7 * plain.lbs_weights + 0.3 * rng.dirichlet(np.full(24, 0.15), n)  # more bones than are kept
    more = {
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(1e-3, 0.05, (n, 3)),
        "shN": rng.normal(0, 0.1, (n, 3, 3)),
        "lbs_weights": weights,
    }
    return replace(plain, **more, antialias=True)


@pytest.fixture(scope="module")
def file(avatar, tmp_path_factory):
    return write(avatar, tmp_path_factory.mktemp("glb") / "avatar_splats.glb")


def write(avatar, path, names="smpl"):
    rig = rig_of(avatar)
    write_splats_glb(path, rig, made_takes(rig.joints[0])[:1], names, FLOOR)
    return path


def test_an_avatar_comes_back_in_the_t_pose(avatar, file):
    rig, back = rig_of(avatar), read_avatar_glb(file)
    for name in ("means", "scales", "opacities", "sh0", "shN", "betas", "parents"):
        np.testing.assert_array_equal(getattr(back, name), getattr(rig, name), name)
    np.testing.assert_allclose(back.joints, rig.joints, atol=1e-6)
    np.testing.assert_array_equal(back.quats, rig.quats)
    assert back.antialias and not back.canonical_pose.any() and back.clothes is None
    np.testing.assert_allclose(back.lbs_weights.sum(1), 1, atol=1e-6)
    kept = np.sort(avatar.lbs_weights, 1)[:, -8:].sum(1)
    assert np.abs(back.lbs_weights * kept[:, None] - avatar.lbs_weights).max() < 1 - kept.min() + 1e-4


def test_a_program_that_skins_by_the_file_puts_gaussians_where_we_do(avatar, file):
    glb, pose = Glb(file), 40
    take = made_takes(rig_of(avatar).joints[0])[0]
    rotvecs = Rotation.from_quat(take.rotations[pose], scalar_first=True).as_rotvec().reshape(72)
    step = torch.as_tensor(take.pelvis[pose] - rig_of(avatar).joints[0] - [0, FLOOR, 0]).float()
    turn = torch.as_tensor(rotvecs).float()
    back = read_avatar_glb(file)
    eight = replace(avatar, **{n: getattr(back, n) for n in ("means", "quats", "scales", "shN")})
    eight = replace(eight, lbs_weights=back.lbs_weights, canonical_pose=np.zeros(69))
    there = pose_avatar(load_avatar(eight), turn[:3], turn[3:], step).means.numpy()
    np.testing.assert_allclose(skinned(glb, pose), there, atol=5e-6)


def test_bones_of_clothes_are_joints_that_motions_swing_and_hugs_reads_them_back(avatar, tmp_path):
    dressed = dress(avatar, some_clothes())
    rig, baked = rig_of(dressed), load_avatar(dressed)
    take = hung(baked, made_takes(rig.joints[0])[0])
    write_splats_glb(tmp_path / "dressed.glb", rig, [take])
    glb, pose = Glb(tmp_path / "dressed.glb"), 25
    (skin,) = glb.content["skins"]
    assert [glb.content["nodes"][node]["name"] for node in skin["joints"][24:]] == [f"cloth_{k:02d}" for k in range(5)]
    world, rest = world_of(glb, pose), world_of(glb)
    poses = list(zip(*_poses(baked, take)))
    bones = bones_of(baked, *poses[pose][:2])[24:].numpy()
    step = take.pelvis[pose] - rig.joints[0]
    for node, bone, centre in zip(skin["joints"][24:], bones, dressed.clothes.centres):
        np.testing.assert_allclose(world[node][:3, 3], bone[:3, :3] @ centre + bone[:3, 3] + step, atol=2e-5)
        u, _, vt = np.linalg.svd(bone[:3, :3])
        np.testing.assert_allclose(world[node][:3, :3] @ rest[node][:3, :3].T, u @ vt, atol=2e-4)
    back = read_avatar_glb(tmp_path / "dressed.glb")
    assert back.lbs_weights.shape == (len(avatar), 29)
    for name, values in vars(some_clothes()).items():
        np.testing.assert_allclose(getattr(back.clothes, name), values, rtol=1e-6)
    both = [pose_avatar(one, *poses[pose]).means for one in (baked, load_avatar(back))]
    assert (both[0] - both[1]).norm(dim=1).median() < 0.005, "up to bones beyond eight"


@pytest.fixture(scope="module")
def bent():
    """An avatar with fingers, which lie bent, and a take that moves them."""
    rng = np.random.default_rng(0)
    avatar = attach(make_avatar(MODEL, every=5), MODEL, read_hands_face(MODEL), rng.normal(0, 0.2, (2, 15, 3)))
    take = made_takes(avatar.joints[0])[0]
    return avatar, hung(load_avatar(avatar), replace(take, hands=rng.normal(0, 0.4, (len(take), 2, 15, 3))))


def test_fingers_are_joints_that_motions_bend_as_we_do_and_hugs_reads_them_back(bent, tmp_path):
    avatar, take = bent
    write_splats_glb(tmp_path / "a.glb", rig_of(avatar), [take])
    back, pose = read_avatar_glb(tmp_path / "a.glb"), 25
    there = []
    for one in (avatar, back):
        baked = load_avatar(one)
        moved = [part[pose] for part in _poses(baked, take)]
        there.append(PosedAvatar.of(baked, *moved, hands=take.hands[pose][None]).splats(0).means.numpy())
    np.testing.assert_allclose(skinned(Glb(tmp_path / "a.glb"), pose), there[0], atol=1e-4)
    np.testing.assert_allclose(there[1], there[0], atol=1e-4)
    np.testing.assert_array_equal(back.fingers.rows, avatar.fingers.rows)
    np.testing.assert_allclose(back.lbs_weights.sum(1), 1, atol=1e-6)


def test_colours_are_linear(avatar, file):
    glb = Glb(file)
    (gaussians,) = (mesh["primitives"][0]["attributes"] for mesh in glb.content["meshes"])
    found = array(glb, gaussians["COLOR_0"])
    shown = np.clip(0.5 + 0.28209479 * avatar.sh0, 0, 1)
    np.testing.assert_allclose(found[:, :3], ((shown + 0.055) / 1.055) ** 2.4, atol=1e-4)
    np.testing.assert_allclose(found[:, 3], avatar.opacities, atol=1e-4)
    assert [name for name in gaussians if name.startswith("_")] == ["_SCALE"], "Blender mixes up several"


def test_the_same_avatar_makes_the_same_bytes(avatar, file, tmp_path):
    assert write(avatar, tmp_path / "again.glb").read_bytes() == file.read_bytes()


ELBOWS = {"mixamo": "mixamorig:LeftForeArm", "vrm": "leftLowerArm", "unreal": "lowerarm_l"}


@pytest.mark.parametrize(("names", "left_elbow"), ELBOWS.items())
def test_joints_have_the_names_of_other_skeletons(avatar, tmp_path, names, left_elbow):
    nodes = Glb(write(avatar, tmp_path / "a.glb", names)).content["nodes"]
    assert [node["name"] for node in nodes][2 + 18] == left_elbow
    assert len(set(bone_names(names))) == 24
    assert read_avatar_glb(tmp_path / "a.glb").parents[18] == 16


def edited(path, change):
    """The bytes of a GLB whose JSON `change` has changed, in place."""
    glb = Glb(path)
    change(glb.content)
    arrays = Arrays()
    arrays.data = bytearray(glb.data)
    arrays.views, arrays.accessors = glb.content["bufferViews"], glb.content["accessors"]
    write_glb(path, glb.content, arrays)


def splat(content):
    return content["meshes"][0]["primitives"][0]["attributes"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.pop("extras"), "no Gaussians of hugs"),
        (lambda c: c["extras"]["hugs"].update(format=3), "another version"),
        (lambda c: c["extras"]["hugs"].update(betas=[0, 1]), "found 2, wanted 10"),
        (lambda c: c["extras"]["hugs"].update(betas="x"), "damaged"),
        (lambda c: c["meshes"].pop(), "damaged"),
        (lambda c: splat(c).pop("WEIGHTS_1"), "WEIGHTS_1"),
        (lambda c: splat(c).update(POSITION=-1), "index"),
        (lambda c: c["accessors"][splat(c)["POSITION"]].update(count=10**12), "out of the file"),
        (lambda c: c["accessors"][splat(c)["POSITION"]].update(componentType=5121), "packed"),
        (
            lambda c: c["bufferViews"][c["accessors"][splat(c)["POSITION"]]["bufferView"]].update(byteOffset=-4),
            "reaches",
        ),
        (
            lambda c: c["accessors"][splat(c)[f"{SPLATS}:SCALE"]].update(count=3),
            "found 3x3",
        ),
        (lambda c: c["nodes"][3].update(children=[2]), "tree"),
        (lambda c: c["nodes"][3].update(children=[99]), "damaged"),
        (lambda c: c["skins"][0].update(joints=[2, 3]), "damaged"),
    ],
)
def test_files_that_lie_are_refused_by_name(file, tmp_path, change, said):
    shutil.copy(file, tmp_path / "a.glb")
    edited(tmp_path / "a.glb", change)
    with pytest.raises(StageError) as refused:
        read_avatar_glb(tmp_path / "a.glb")
    assert said in f"{refused.value} {' '.join(refused.value.facts)}" and "a.glb" in str(refused.value)


def test_a_file_of_a_mesh_alone_is_refused_with_the_name_of_the_one_that_is_wanted(avatar, tmp_path):
    write_avatar_glb(tmp_path / "a.glb", rig_of(avatar), body_mesh(MODEL), [])
    with pytest.raises(StageError) as refused:
        read_avatar_glb(tmp_path / "a.glb")
    assert holds(str(refused.value), "a.glb", "Gaussians") and "avatar_splats.glb" in refused.value.hint


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "no GLB"),
        (b"glTF" + bytes(30), "version 2"),
        (struct.pack("<4sII", b"glTF", 2, 32) + struct.pack("<I4s", 2**31, b"JSON") + bytes(12), "damaged"),
        (struct.pack("<4sII", b"glTF", 2, 24) + struct.pack("<I4s", 4, b"JSON") + b"{}  ", "no arrays"),
        (struct.pack("<4sII4x", b"glTF", 2, 20) + bytes(4), "damaged"),
    ],
)
def test_what_is_no_glb_is_refused(tmp_path, data, said):
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(StageError, match=said):
        read_avatar_glb(tmp_path / "a.glb")


def test_deep_json_is_refused(tmp_path):
    text = b"[" * 200_000
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text)) + struct.pack("<I4s", len(text), b"JSON")
    (tmp_path / "a.glb").write_bytes(head + text + struct.pack("<I4s", 0, b"BIN\0"))
    with pytest.raises(StageError, match="JSON"):
        read_avatar_glb(tmp_path / "a.glb")


def test_numbers_that_are_not_finite_are_refused(avatar, tmp_path):
    broken = replace(rig_of(avatar), sh0=np.full((len(avatar), 3), np.nan, np.float32))
    write_splats_glb(tmp_path / "a.glb", replace(broken, sh0=np.zeros_like(broken.sh0)), [])
    data = bytearray((tmp_path / "a.glb").read_bytes())
    glb = Glb(tmp_path / "a.glb")
    number = splat(glb.content)[f"{SPLATS}:SH_DEGREE_0_COEF_0"]
    at = glb.content["bufferViews"][glb.content["accessors"][number]["bufferView"]]["byteOffset"]
    start = len(data) - len(glb.data) + at
    data[start : start + 4] = struct.pack("<f", float("nan"))
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(StageError) as refused:
        read_avatar_glb(tmp_path / "a.glb")
    assert "sh0 in a.glb" in str(refused.value) and "[0, 0]" in refused.value.facts[0]


def test_dark_colours_are_linear_below_the_power_law():
    dark = np.array([[0.0, 0.02, 0.04], [0.05, 0.5, 1.0]])
    expected = np.array([[0, 0.02 / 12.92, 0.04 / 12.92], [0.00393593, 0.21404114, 1]])
    np.testing.assert_allclose(_linear(dark, np.ones(2))[:, :3] / 65535, expected, atol=1e-5)


def test_a_quaternion_of_zeros_is_refused(avatar, tmp_path):
    quats = avatar.quats.copy()
    write_splats_glb(tmp_path / "a.glb", replace(rig_of(avatar), quats=0 * quats), [], "smpl", FLOOR)
    with pytest.raises(StageError, match=r"a\.glb") as refused:
        read_avatar_glb(tmp_path / "a.glb")
    assert holds(refused.value.facts[0], "quaternion", "row 0")

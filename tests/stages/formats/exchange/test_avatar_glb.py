"""avatar.glb: what is written comes back, skins as we do, and files that lie are refused by name."""

import json
import os
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import bones_of, load_avatar, pose_avatar
from stages.avatar.drawing.rig import rig_of
from stages.avatar.drawing.surface import surface_of
from stages.avatar.drawing.takes import _poses, hung
from stages.avatar.motion.takes import made_takes
from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.exchange.avatar_glb import (
    SPLATS,
    _linear,
    _surface,
    read_avatar_glb,
    write_avatar_glb,
    write_film_glb,
)
from stages.formats.exchange.bone_names import bone_names
from stages.formats.exchange.glb import Arrays, Glb, write_glb
from stages.records import Mesh
from tests.made.clothes import dress, some_clothes
from tests.made.tiny import make_avatar

MODEL = read_body_model()
FLOOR = -1.2  # m: where the T-pose's soles are
KINDS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


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
    return write(avatar, tmp_path_factory.mktemp("glb") / "avatar.glb")


def write(avatar, path, names="smpl"):
    rig = rig_of(avatar)
    write_avatar_glb(path, rig, surface_of(MODEL, rig), made_takes(rig.joints[0])[:1], names, FLOOR)
    return path


def array(glb, number):
    """An accessor's values, read by the rules of glTF, not with our reader."""
    accessor = glb.content["accessors"][number]
    view = glb.content["bufferViews"][accessor["bufferView"]]
    columns, kind = KINDS[accessor["type"]], TYPES[accessor["componentType"]]
    values = np.frombuffer(glb.data, kind, accessor["count"] * columns, view["byteOffset"]).reshape(-1, columns)
    return values / np.iinfo(kind).max if accessor.get("normalized") else values


def test_an_avatar_comes_back_in_the_t_pose(avatar, file):
    rig, back = rig_of(avatar), read_avatar_glb(file)
    for name in ("means", "scales", "opacities", "sh0", "shN", "betas", "joints", "parents"):
        np.testing.assert_array_equal(getattr(back, name), getattr(rig, name), name)
    np.testing.assert_array_equal(back.quats, rig.quats)
    assert back.antialias and not back.canonical_pose.any() and back.clothes is None
    np.testing.assert_allclose(back.lbs_weights.sum(1), 1, atol=1e-6)
    kept = np.sort(avatar.lbs_weights, 1)[:, -8:].sum(1)
    assert np.abs(back.lbs_weights * kept[:, None] - avatar.lbs_weights).max() < 1 - kept.min() + 1e-4


def test_a_program_that_skins_by_the_file_puts_mesh_and_gaussians_where_we_do(avatar, file, held):
    glb, pose = Glb(file), 40
    take = made_takes(rig_of(avatar).joints[0])[0]
    nodes, (skin,), (move,) = (glb.content[name] for name in ("nodes", "skins", "animations"))
    local = {node: np.array(nodes[node].get("translation", [0, 0, 0]), float) for node in skin["joints"]}
    turns = dict.fromkeys(skin["joints"], np.eye(3))
    for channel in move["channels"]:
        sampler = move["samplers"][channel["sampler"]]
        value, node = array(glb, sampler["output"])[pose], channel["target"]["node"]
        if channel["target"]["path"] == "rotation":
            turns[node] = Rotation.from_quat(value).as_matrix()
        else:
            local[node] = value
        assert array(glb, sampler["input"])[pose, 0] == pytest.approx(take.times[pose])
    root, stand = skin["joints"][0], nodes[2]
    assert stand["children"] == [root] and glb.content["scenes"][0]["nodes"] == [0, 1, 2]
    world = {root: (turns[root], local[root] + stand["translation"])}
    for node in skin["joints"]:
        turn, place = world[node]
        for child in nodes[node].get("children", ()):
            world[child] = (turn @ turns[child], turn @ local[child] + place)
    binds = array(glb, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    bones = np.stack([np.column_stack(world[node]) for node in skin["joints"]]) @ binds

    def skinned(primitive):
        attributes, blend = primitive["attributes"], 0
        for i in range(8):
            if f"JOINTS_{i // 4}" in attributes:
                joint = array(glb, attributes[f"JOINTS_{i // 4}"])[:, i % 4]
                blend = blend + bones[joint] * array(glb, attributes[f"WEIGHTS_{i // 4}"])[:, i % 4, None, None]
        points = array(glb, attributes["POSITION"])
        return (blend[:, :, :3] @ points[..., None])[..., 0] + blend[:, :, 3]

    rotvecs = Rotation.from_quat(take.rotations[pose], scalar_first=True).as_rotvec().reshape(72)
    step = torch.as_tensor(take.pelvis[pose] - rig_of(avatar).joints[0] - [0, FLOOR, 0]).float()
    turn = torch.as_tensor(rotvecs).float()
    body, gaussians = (mesh["primitives"][0] for mesh in glb.content["meshes"])
    there = Body(MODEL)(torch.zeros(10), turn[None, :3], turn[None, 3:], step[None])[0][0].numpy()
    held(np.linalg.norm(skinned(body) - there, axis=1).max() * 1000, 1.5, "vertices, mm")
    eight = replace(avatar, **{n: getattr(read_avatar_glb(file), n) for n in ("means", "quats", "scales", "shN")})
    eight = replace(eight, lbs_weights=read_avatar_glb(file).lbs_weights, canonical_pose=np.zeros(69))
    there = pose_avatar(load_avatar(eight), turn[:3], turn[3:], step).means.numpy()
    np.testing.assert_allclose(skinned(gaussians), there, atol=2e-6)


def test_bones_of_clothes_are_joints_that_motions_swing_and_hugs_reads_them_back(avatar, tmp_path):
    dressed = dress(avatar, some_clothes())
    rig, baked = rig_of(dressed), load_avatar(dressed)
    take = hung(baked, made_takes(rig.joints[0])[0])
    write_avatar_glb(tmp_path / "dressed.glb", rig, surface_of(MODEL, rig), [take])
    glb, pose = Glb(tmp_path / "dressed.glb"), 25
    nodes, (skin,), (move,) = (glb.content[name] for name in ("nodes", "skins", "animations"))
    assert [nodes[node]["name"] for node in skin["joints"][24:]] == [f"cloth_{k:02d}" for k in range(5)]
    local = {node: (np.eye(3), np.array(nodes[node].get("translation", [0, 0, 0]), float)) for node in skin["joints"]}
    for channel in move["channels"]:
        value, node = array(glb, move["samplers"][channel["sampler"]]["output"])[pose], channel["target"]["node"]
        turn, place = local[node]
        turned = channel["target"]["path"] == "rotation"
        local[node] = (Rotation.from_quat(value).as_matrix(), place) if turned else (turn, value)
    world = {skin["joints"][0]: local[skin["joints"][0]]}
    for node in skin["joints"]:  # parents come first
        turn, place = world[node]
        for child in nodes[node].get("children", ()):
            world[child] = (turn @ local[child][0], turn @ local[child][1] + place)
    poses = list(zip(*_poses(baked, take)))
    bones = bones_of(baked, *poses[pose][:2])[24:].numpy()
    step = take.pelvis[pose] - rig.joints[0]
    for node, bone, centre in zip(skin["joints"][24:], bones, dressed.clothes.centres):
        np.testing.assert_allclose(world[node][1], bone[:3, :3] @ centre + bone[:3, 3] + step, atol=2e-5)
        u, _, vt = np.linalg.svd(bone[:3, :3])
        np.testing.assert_allclose(world[node][0], u @ vt, atol=2e-4)
    back = read_avatar_glb(tmp_path / "dressed.glb")
    assert back.lbs_weights.shape == (len(avatar), 29)
    for name, values in vars(some_clothes()).items():
        np.testing.assert_allclose(getattr(back.clothes, name), values, rtol=1e-6)
    both = [pose_avatar(one, *poses[pose]).means for one in (baked, load_avatar(back))]
    assert (both[0] - both[1]).norm(dim=1).median() < 0.005, "up to bones beyond eight"


def test_colours_are_linear_and_the_mesh_has_those_of_the_gaussians(avatar, file):
    glb = Glb(file)
    body, gaussians = (mesh["primitives"][0]["attributes"] for mesh in glb.content["meshes"])
    found = array(glb, gaussians["COLOR_0"])
    shown = np.clip(0.5 + 0.28209479 * avatar.sh0, 0, 1)
    np.testing.assert_allclose(found[:, :3], ((shown + 0.055) / 1.055) ** 2.4, atol=1e-4)
    np.testing.assert_allclose(found[:, 3], avatar.opacities, atol=1e-4)
    assert body["COLOR_0"] != gaussians["COLOR_0"]
    head = MODEL.lbs_weights[:, 15] > 0.99
    yellow = ((np.array([0.9, 0.9, 0.1]) + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(array(glb, body["COLOR_0"])[head, :3].mean(0), yellow, atol=0.05)
    normals = array(glb, body["NORMAL"])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert [name for name in gaussians if name.startswith("_")] == ["_SCALE"], "Blender mixes up several"


def test_the_same_avatar_makes_the_same_bytes(avatar, file, tmp_path):
    assert write(avatar, tmp_path / "again.glb").read_bytes() == file.read_bytes()


ELBOWS = {"mixamo": "mixamorig:LeftForeArm", "vrm": "leftLowerArm", "unreal": "lowerarm_l"}


@pytest.mark.parametrize(("names", "left_elbow"), ELBOWS.items())
def test_joints_have_the_names_of_other_skeletons(avatar, tmp_path, names, left_elbow):
    nodes = Glb(write(avatar, tmp_path / "a.glb", names)).content["nodes"]
    assert [node["name"] for node in nodes][3 + 18] == left_elbow
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
    return content["meshes"][1]["primitives"][0]["attributes"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.pop("extras"), "no avatar of hugs"),
        (lambda c: c["extras"]["hugs"].update(format=2), "another version"),
        (lambda c: c["extras"]["hugs"].update(betas=[0, 1]), "betas in a.glb has the wrong shape found 2, wanted 10"),
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
            "scales in a.glb has the wrong shape found 3x3",
        ),
        (lambda c: c["nodes"][4].update(children=[3]), "tree"),
        (lambda c: c["nodes"][4].update(children=[99]), "damaged"),
        (lambda c: c["skins"][0].update(joints=[2, 3]), "damaged"),
    ],
)
def test_files_that_lie_are_refused_by_name(file, tmp_path, change, said):
    shutil.copy(file, tmp_path / "a.glb")
    edited(tmp_path / "a.glb", change)
    with pytest.raises(StageError) as refused:
        read_avatar_glb(tmp_path / "a.glb")
    assert said in f"{refused.value} {' '.join(refused.value.facts)}" and "a.glb" in str(refused.value)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "no GLB"),
        (b"glTF" + bytes(30), "no GLB of version 2"),
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
    write_avatar_glb(
        tmp_path / "a.glb", replace(broken, sh0=np.zeros_like(broken.sh0)), surface_of(MODEL, rig_of(avatar)), []
    )
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


@pytest.mark.slow
def test_the_validator_of_khronos_complains_of_nothing_but_names_it_does_not_know(file):
    """Where Node is, and HUGS_NODE_MODULES names a folder with the npm package gltf-validator."""
    modules = os.environ.get("HUGS_NODE_MODULES")
    if not modules or not shutil.which("node"):
        pytest.skip("HUGS_NODE_MODULES names no folder with gltf-validator, or there is no node")
    script = (
        "require(process.argv[1]+'/gltf-validator').validateBytes(new Uint8Array(require('fs').readFileSync("
        "process.argv[2])),{maxIssues:0}).then(r=>console.log(JSON.stringify(r.issues.messages)))"
    )
    said = subprocess.run(["node", "-e", script, modules, str(file)], capture_output=True, text=True, check=True)
    unknown = [m for m in json.loads(said.stdout) if SPLATS not in m["message"] + m["pointer"]]
    assert [m for m in unknown if m["code"] != "UNSUPPORTED_EXTENSION"] == []


@pytest.mark.slow
def test_blender_poses_mesh_and_gaussians_as_we_do(tmp_path, held):
    """Where HUGS_BLENDER_PYTHON names a Python that has bpy."""
    python = os.environ.get("HUGS_BLENDER_PYTHON")
    if not python:
        pytest.skip("HUGS_BLENDER_PYTHON names no Python with bpy")
    avatar = make_avatar(MODEL)
    rig, truth = rig_of(avatar), {}
    takes, pose = made_takes(rig.joints[0]), 60
    write_avatar_glb(tmp_path / "a.glb", rig, surface_of(MODEL, rig), takes)
    for take in takes:
        turns = Rotation.from_quat(take.rotations[pose], scalar_first=True).as_rotvec().reshape(72)
        step = torch.as_tensor(take.pelvis[pose] - rig.joints[0]).float()
        turn = torch.as_tensor(turns).float()
        truth[f"{take.name}_frame"] = np.array(pose)
        truth[f"{take.name}_body"] = Body(MODEL)(torch.zeros(10), turn[None, :3], turn[None, 3:], step[None])[0][
            0
        ].numpy()
        truth[f"{take.name}_gaussians"] = pose_avatar(load_avatar(avatar), turn[:3], turn[3:], step).means.numpy()
    np.savez(tmp_path / "truth.npz", **truth)
    script = Path(__file__).parents[3] / "tools" / "in_blender.py"
    command = [python, str(script), str(tmp_path / "a.glb"), str(tmp_path / "truth.npz")]
    plain = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    said = subprocess.run(command, capture_output=True, text=True, check=True, env=plain).stdout
    found = json.loads(said.strip().splitlines()[-1])
    assert set(found["motions"]) == {take.name for take in takes} and "_SCALE" in found["attributes"]
    assert set(found["bones"]) == set(bone_names("smpl"))
    for name, away in found["motions"].items():
        held(away["body"][1], 1.5, f"largest distance of a vertex in {name}, mm")
        held(away["gaussians"][0], 0.5, f"mean distance of Gaussians in {name}, mm")


def test_in_a_film_each_person_has_a_motion_and_a_size_of_their_own(avatar, tmp_path):
    rig = rig_of(avatar)
    takes = made_takes(rig.joints[0])[:2]
    places, quat = ([0.5, 0.0, 1.0], [-2.0, 0.0, 0.0]), [0.0, 0.0, 0.0, 1.0]
    figures = [(f"p{k}", rig, None, take, (places[k], quat, 1.0 + k)) for k, take in enumerate(takes)]
    write_film_glb(tmp_path / "a.glb", figures, None)
    glb = Glb(tmp_path / "a.glb")
    (moves,), nodes = glb.content["animations"], glb.content["nodes"]
    for k, take in enumerate(takes):
        (stand,) = (node for node in nodes if node["name"] == f"p{k}")
        assert stand["translation"] == places[k] and stand["scale"] == [1.0 + k] * 3
        first = stand["children"][0]
        for channel in moves["channels"]:
            joint, sampler = channel["target"]["node"] - first, moves["samplers"][channel["sampler"]]
            if 0 <= joint < 24:
                turns = (
                    take.pelvis
                    if channel["target"]["path"] == "translation"
                    else take.rotations[:, joint, [1, 2, 3, 0]]
                )
                np.testing.assert_allclose(array(glb, sampler["output"]), turns, atol=1e-6)
                np.testing.assert_allclose(array(glb, sampler["input"])[:, 0], take.times, atol=1e-6)


@pytest.mark.parametrize(("count", "kind"), [(300, 5123), ((1 << 16) - 1, 5123), (1 << 16, 5125), (70_000, 5125)])
def test_a_mesh_of_many_vertices_has_wider_indices(count, kind):
    rows, arrays = np.zeros((count, 3)), Arrays()
    mesh = Mesh(
        rows, rows, np.array([[0, 1, count - 1]]), rows, np.zeros((count, 4), np.uint8), np.zeros((count, 4), np.uint8)
    )
    made = arrays.accessors[_surface(mesh, arrays)["indices"]]
    assert made["componentType"] == kind
    view = arrays.views[made["bufferView"]]
    assert np.frombuffer(arrays.data, TYPES[kind], 3, view["byteOffset"])[2] == count - 1


def test_dark_colours_are_linear_below_the_power_law():
    dark = np.array([[0.0, 0.02, 0.04], [0.05, 0.5, 1.0]])
    expected = np.array([[0, 0.02 / 12.92, 0.04 / 12.92], [0.00393593, 0.21404114, 1]])
    np.testing.assert_allclose(_linear(dark, np.ones(2))[:, :3] / 65535, expected, atol=1e-5)


def test_a_quaternion_of_zeros_is_refused(avatar, tmp_path):
    quats = avatar.quats.copy()
    write_avatar_glb(tmp_path / "a.glb", replace(rig_of(avatar), quats=0 * quats), None, [], "smpl", FLOOR)
    with pytest.raises(StageError, match="is damaged") as refused:
        read_avatar_glb(tmp_path / "a.glb")
    assert "a quaternion of zeros, the first is row 0" in refused.value.facts[0]

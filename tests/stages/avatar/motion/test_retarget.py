"""Motions come back from skeletons that stand, measure and are named differently."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import Body
from stages.avatar.motion import retarget
from stages.avatar.motion.formulas import MOTIONS
from stages.formats.body_model import read_body_model
from stages.formats.motions.bvh import read_bvh
from stages.formats.motions.bvh_names import map_body
from tests.made import bvh as bvh_made
from tests.made.skeleton import PARENTS

Z_UP = Rotation.from_euler("x", 90, degrees=True).as_matrix()


@pytest.fixture(scope="module")
def joints():
    return Body(read_body_model(), torch.float64).rest(torch.zeros(10, dtype=torch.float64))[1].numpy()


@pytest.fixture(scope="module")
def truth():
    """Jumping jacks with twisted limbs and a turning body: local rotations [F,24,3,3], hips [F,3]."""
    orient, pose, transl = (t.numpy().astype(float) for t in MOTIONS["jumping_jacks"](2.0, 50))
    local = bvh_made.matrices(orient, pose)
    swing = np.sin(np.linspace(0, 6, len(local)))[:, None]
    local[:, 0] = Rotation.from_rotvec(swing * [0.1, 0.8, 0.1]).as_matrix()
    for joint, axis in (
        (16, [0.9, 0, 0]),
        (2, [0, 0.5, 0]),
        (20, [0.3, 0.2, 0]),
        (6, [0.2, 0.3, 0.1]),
        (15, [0.1, 0.5, 0]),
    ):
        local[:, joint] = local[:, joint] @ Rotation.from_rotvec(swing * axis).as_matrix()
    return local, transl + swing * [0.3, 0, 0.2]


def retargeted(path, joints):
    bvh = read_bvh(path)
    body = map_body(bvh, path)
    skeleton = retarget.Skeleton(bvh.names, bvh.parents, bvh.places, bvh.rotations)
    return retarget.from_skeleton(skeleton, body.limbs, body.pelvis, body.spine, body.neck, joints, PARENTS)


def degrees(a, b):
    """Angles between rotations [...,3,3]."""
    return np.degrees(Rotation.from_matrix((a.mT @ b).reshape(-1, 3, 3)).magnitude()).reshape(a.shape[:-2])


def limb_errors(found, true, joints):
    """Degrees between the bones of all arms and legs in the world [F,8]."""
    errors = []
    for joint, end in retarget.LIMBS.items():
        bone = joints[end] - joints[joint]
        a, b = (bvh_made.world_of(local)[:, joint] @ bone / np.linalg.norm(bone) for local in (found, true))
        errors.append(2 * np.degrees(np.arcsin(np.linalg.norm(a - b, axis=-1).clip(max=2) / 2)))
    return np.stack(errors, 1)


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "YZX"])
@pytest.mark.parametrize("to_file", [None, Z_UP], ids=["y-up", "z-up"])
def test_a_motion_comes_back_from_an_a_pose(tmp_path, joints, truth, order, to_file):
    local, hips = truth
    path = bvh_made.write_bvh(
        tmp_path / "a.bvh", joints * 1.3, local, hips, bvh_made.a_pose(), order=order, to_file=to_file
    )
    found = retargeted(path, joints)
    back = np.eye(3) if to_file is None else to_file.T
    rotations = found.rotations.copy()
    rotations[:, 0] = back @ rotations[:, 0]
    assert limb_errors(rotations, local, joints).max() < 0.01
    assert degrees(rotations[:, :22], local[:, :22]).max() < 0.1, "twist, trunk, head, feet and hands too"
    assert found.leg == pytest.approx(1.3 * 100 * retarget.leg_of(joints), rel=1e-6)
    middle = np.ptp(found.hips @ back.T, axis=0)[[0, 2]]
    np.testing.assert_allclose(middle, 100 * np.ptp(hips, axis=0)[[0, 2]], atol=6)  # hips swing about the root a little


def test_a_skeleton_whose_zero_pose_nobody_can_stand_in(tmp_path, joints, truth):
    local, hips = truth
    path = bvh_made.write_bvh(tmp_path / "x.bvh", joints, local, hips, bvh_made.bones_along_x(joints))
    found = retargeted(path, joints).rotations
    assert limb_errors(found, local, joints).max() < 0.01
    away = bvh_made.world_of(found).mT @ bvh_made.world_of(local)
    assert degrees(away, away[:1]).max() < 3, "the twist at the start is not known, but from there on it is kept"
    assert degrees(away, np.broadcast_to(np.eye(3), away.shape)).max() < 50
    trunk = [0, *retarget.SPINE, retarget.NECK, retarget.HEAD]
    assert degrees(found[:, trunk], local[:, trunk]).max() < 3


def test_a_bone_with_a_joint_inside_keeps_pointing_to_its_end(joints):
    """Twist and roll bones: between hip and knee stands one more joint, and bends."""
    parents = [*PARENTS[:4], 24, *PARENTS[5:], 1]
    order = [0, 1, 2, 3, 24, *range(4, 24)]
    places = np.array([np.zeros(3), *(joints[j] - joints[PARENTS[j]] for j in range(1, 24)), np.zeros(3)])
    places[24] = places[4] = (joints[4] - joints[1]) / 2
    rotations = np.tile(np.eye(3), (5, 25, 1, 1))
    rotations[:, 24] = Rotation.from_euler("x", np.linspace(0, 40, 5)[:, None], degrees=True).as_matrix()
    back = {joint: i for i, joint in enumerate(order)}
    skeleton = retarget.Skeleton(
        [str(j) for j in order],
        np.array([-1 if parents[j] < 0 else back[parents[j]] for j in order]),
        np.tile(places[order], (5, 1, 1)),
        rotations[:, order],
    )
    limbs = {joint: back[joint] for joint in (*retarget.LIMBS, *retarget.ANKLES, *retarget.WRISTS)}
    spine = [back[joint] for joint in retarget.SPINE]
    found = retarget.from_skeleton(skeleton, limbs, 0, spine, [back[12], back[15]], joints, PARENTS)
    bone = joints[4] - joints[1]
    bent = bone / 2 + rotations[:, 24] @ bone / 2
    thigh = bvh_made.world_of(found.rotations)[:, 1] @ bone
    np.testing.assert_allclose(thigh / np.linalg.norm(bone), bent / np.linalg.norm(bent, axis=1)[:, None], atol=1e-9)


def test_one_spine_joint_bends_all_three_evenly(tmp_path, joints, truth):
    local, hips = truth
    local = np.tile(np.eye(3), (3, 24, 1, 1))
    local[:, 3] = Rotation.from_euler("x", [[0], [30], [60]], degrees=True).as_matrix()
    path = bvh_made.write_bvh(tmp_path / "s.bvh", joints, local, hips[:3], bvh_made.a_pose())
    bvh = read_bvh(path)
    body = map_body(bvh, path)
    skeleton = retarget.Skeleton(bvh.names, bvh.parents, bvh.places, bvh.rotations)
    found = retarget.from_skeleton(skeleton, body.limbs, body.pelvis, body.spine[:1], (), joints, PARENTS).rotations
    bends = np.degrees(Rotation.from_matrix(found[2, list(retarget.SPINE)]).magnitude())
    np.testing.assert_allclose(bends, [20, 20, 20], atol=1e-3)


def test_bones_without_length_are_refused(tmp_path, joints, truth):
    local, hips = truth
    squashed = joints.copy()
    squashed[4] = squashed[1]
    path = bvh_made.write_bvh(tmp_path / "s.bvh", squashed, local, hips, bvh_made.a_pose())
    with pytest.raises(ValueError, match=r"LeftUpLeg.*LeftLeg.*100 of 100"):
        retargeted(path, joints)


def test_resampling_keeps_time_and_turns_evenly():
    local = np.tile(np.eye(3), (11, 24, 1, 1))
    local[:, 5] = Rotation.from_euler("y", np.linspace(0, 100, 11)[:, None], degrees=True).as_matrix()
    hips = np.linspace(0, 1, 11)[:, None] * [1, 2, 3]
    found = retarget.resample(retarget.Performance(local, hips, 1.0), 10, 25)
    assert len(found.hips) == 26  # 1 s, both ends
    angles = np.degrees(Rotation.from_matrix(found.rotations[:, 5]).magnitude())
    np.testing.assert_allclose(angles, np.linspace(0, 100, 26), atol=1e-6)
    np.testing.assert_allclose(found.hips, np.linspace(0, 1, 26)[:, None] * [1, 2, 3], atol=1e-9)
    assert len(retarget.resample(found, 25, 3).hips) == 4


ONWARDS = [0.0, 1e-12, 1e-9, 1e-7, 1e-4, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-7, np.pi, np.pi + 1e-7, np.pi + 1e-4, 6.2]


@pytest.mark.parametrize("onwards", ONWARDS)
def test_d09_between_two_frames_a_joint_turns_evenly_and_the_short_way(onwards, held):
    """From equal frames to opposite ones and beyond, also in numbers of a file, which are no rotations to the last digit."""
    rng = np.random.default_rng(0)
    starts, axes = Rotation.random(24, rng=rng), rng.normal(size=(24, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    short = onwards if onwards <= np.pi else onwards - 2 * np.pi
    for rounded, bound in (
        (np.float64, 1e-7),
        (np.float32, 5e-6),
    ):  # nearer to opposite than digits: either way is short
        both = [(starts * Rotation.from_rotvec(axes * angle)).as_matrix() for angle in (0.0, onwards)]
        motion = retarget.Performance(np.stack(both).astype(rounded).astype(float), np.zeros((2, 3)), 1.0)
        found = retarget.resample(motion, 1, 8).rotations
        turns = found.reshape(-1, 3, 3)
        held(np.abs(turns @ turns.mT - np.eye(3)).max(), 1e-12, "what is missing of a rotation")
        wanted = np.stack(
            [[(starts * Rotation.from_rotvec(way * axes * t)).as_matrix() for t in np.linspace(0, 1, 9)]
             for way in ((short, -short) if abs(abs(short) - np.pi) < 1e-6 else (short,))]
        )  # fmt: skip
        held(np.abs(found - wanted).max((1, 3, 4)).min(0).max(), bound, f"error of {rounded.__name__}")


def test_turns_between_directions():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 200, 3))
    b[:3] = a[:3] * 2
    b[3:9] = -a[3:9]
    b[9:12] = -a[9:12] + 1e-7
    turns = retarget.turn_between(a, b)
    unit = b / np.linalg.norm(b, axis=1)[:, None]
    np.testing.assert_allclose((turns @ a[..., None])[..., 0], unit * np.linalg.norm(a, axis=1)[:, None], atol=1e-7)
    np.testing.assert_allclose(turns @ turns.mT, np.tile(np.eye(3), (200, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1)
    cosine = (a * unit).sum(1) / np.linalg.norm(a, axis=1)
    np.testing.assert_allclose(np.trace(turns, axis1=1, axis2=2), 1 + 2 * cosine, atol=1e-6)  # the smallest turn


@pytest.mark.parametrize("name", ["jesse_dance", "jumping_jacks", "wave_hello"])
def test_real_motions_turn_no_faster_than_in_their_file(clips, joints, name):
    path = clips / "motion" / f"{name}.bvh"
    found, source = retargeted(path, joints).rotations, read_bvh(path).rotations
    steps, own = (degrees(rotations[1:], rotations[:-1]) for rotations in (found, source))
    assert steps.max() < 1.1 * own.max(), f"frame {steps.max(1).argmax()}, joint {steps.max(0).argmax()}"


def test_the_right_hand_of_wave_hello_waves(clips, joints):
    found = retargeted(clips / "motion" / "wave_hello.bvh", joints)
    world = bvh_made.world_of(found.rotations)
    left, right = ((world[:, elbow] @ (joints[wrist] - joints[elbow]))[:, 2] for elbow, wrist in ((18, 20), (19, 21)))
    assert right.max() > 0.12 and left.max() < 0.03  # z is up in this file


@pytest.mark.parametrize("name", ["jesse_dance", "jumping_jacks", "wave_hello"])
def test_a_foot_that_stands_in_the_file_stands_here(clips, joints, held, name):
    """The ankle's speed over the floor, while the file's, of legs as long, moves by under 5 cm/s."""
    path = clips / "motion" / f"{name}.bvh"
    bvh, found = read_bvh(path), retargeted(path, joints)
    skeleton = retarget.Skeleton(bvh.names, bvh.parents, bvh.places, bvh.rotations)
    limbs, source = map_body(bvh, path).limbs, retarget._in_the_world(skeleton)[1][1:]
    world, size = bvh_made.world_of(found.rotations), retarget.leg_of(joints) / found.leg
    floor = [0, 1] if name == "wave_hello" else [0, 2]  # z is up in that file
    for hip, knee, ankle in ((1, 4, 7), (2, 5, 8)):
        bones = joints[hip] - joints[[1, 2]].mean(0), joints[knee] - joints[hip], joints[ankle] - joints[knee]
        ours = found.hips * size + sum(world[:, j] @ bone for j, bone in zip((0, hip, knee), bones, strict=True))
        own, speed = (
            np.linalg.norm(np.diff(at[:, floor], axis=0), axis=1) * bvh.fps
            for at in (source[:, limbs[ankle]] * size, ours)
        )
        held(np.quantile(speed[own < 0.05], 0.9), 0.1, f"m/s of {'left' if ankle == 7 else 'right'} ankles that stand")

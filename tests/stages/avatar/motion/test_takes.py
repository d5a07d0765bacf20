"""Motions as engines play them: the clip's own poses, and made ones, on the floor of the T-pose."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import Body
from stages.avatar.drawing.rig import rig_of
from stages.avatar.motion.placing import Soles
from stages.avatar.motion.takes import clip_take, even, made_takes
from stages.formats.body_model import read_body_model
from tests.made.tiny import EMPTY, FRAMES, make_avatar, make_ground, make_poses

TIMES = np.arange(FRAMES) * 0.1 + 3
GROUND = make_ground(make_poses(), read_body_model())


@pytest.fixture(scope="module")
def soles():
    return Soles.of_model(read_body_model(), np.zeros(10))


def test_the_clip_stands_up_from_the_y_down_world_on_the_floor_of_the_t_pose(soles):
    take = clip_take(make_poses(), TIMES, GROUND, soles)
    assert len(take) == FRAMES - 1 and EMPTY == FRAMES - 1, "nobody is seen in the last frame"
    np.testing.assert_allclose(take.times, np.arange(FRAMES - 1) * 0.1, atol=1e-9)
    root = Rotation.from_quat(take.rotations[:, 0], scalar_first=True)
    assert root.apply([0, 1, 0])[:, 1].min() > 0.999, "heads up"
    np.testing.assert_allclose(root[0].apply([0, 0, 1]), [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(
        take.pelvis[0, [0, 2]], soles.joints[0, [0, 2]], atol=1e-9, err_msg="where the T-pose is"
    )
    feet = take.pelvis[:, 1] - soles.joints[0, 1]
    assert np.abs(feet).max() < 0.005, "straight legs: the pelvis is as high as in the T-pose"


def test_its_poses_are_those_of_the_world_but_for_one_turn_and_one_step(soles):
    body = make_poses()
    take, model = clip_take(body, TIMES, GROUND, soles), Body(read_body_model(), torch.float64)
    pose = torch.as_tensor(body.body_pose[:EMPTY])
    orient, transl = torch.as_tensor(body.global_orient[:EMPTY]), torch.as_tensor(body.transl[:EMPTY])
    there = model(torch.zeros(10).double(), orient, pose, transl)[1].numpy()
    turns = Rotation.from_quat(take.rotations.reshape(-1, 4), scalar_first=True).as_rotvec().reshape(EMPTY, 72)
    moved = torch.as_tensor(take.pelvis) - torch.as_tensor(soles.joints[0])
    here = model(torch.zeros(10).double(), *(torch.as_tensor(t) for t in (turns[:, :3], turns[:, 3:])), moved)[
        1
    ].numpy()
    a, b = (joints.reshape(-1, 3) - joints[0, 0] for joints in (there, here))
    turn, away = Rotation.align_vectors(b, a)
    assert away < 1e-5 and np.abs(turn.apply(a) - b).max() < 1e-6


def test_one_pose_for_a_moment_that_several_cameras_saw(soles):
    body, times = make_poses(), TIMES.copy()
    times[3] = times[2]
    assert len(clip_take(body, times, GROUND, soles)) == FRAMES - 2
    assert clip_take(replace(body, confidence=np.zeros(FRAMES)), times, GROUND, soles) is None


def test_made_motions_never_jump_from_a_quaternion_to_its_negative(soles):
    takes = made_takes(soles.joints[0])
    assert [take.name for take in takes] == ["jumping_jacks", "walk_in_place", "wave", "squats"]
    for take in takes:
        assert (take.rotations[1:] * take.rotations[:-1]).sum(-1).min() > 0.9
        np.testing.assert_allclose(np.linalg.norm(take.rotations, axis=-1), 1)
        assert take.rotations.shape == (120, 24, 4) and take.times[-1] == pytest.approx(119 / 30)


def test_an_avatar_has_the_soles_of_its_body(soles):
    avatar = make_avatar(read_body_model(), every=1)
    own = Soles.of_rig(rig_of(avatar))
    assert own.floor == pytest.approx(soles.floor, abs=0.01)
    bent = np.zeros((2, 69))
    bent[1, 9:15:3] = 0.7
    (a, _), (b, _) = (each.at(np.zeros((2, 3)), bent, np.zeros((2, 3))) for each in (soles, own))
    np.testing.assert_allclose(a[..., 1].min(1), b[..., 1].min(1), atol=0.015)
    floating = replace(avatar, means=np.where(np.arange(len(avatar))[:, None] == 0, [0, -9, 0], avatar.means))
    assert Soles.of_rig(rig_of(floating)).floor == pytest.approx(soles.floor, abs=0.02)
    footless = {name: getattr(avatar, name)[:0] for name in ("means", "quats", "scales", "opacities", "sh0", "shN")}
    ankle = Soles.of_rig(rig_of(replace(avatar, **footless, lbs_weights=np.zeros((0, 24)))))
    assert ankle.floor == pytest.approx(soles.joints[:, 1].min(), abs=1e-6)


def test_a_motion_with_gaps_is_even_at_its_own_pace():
    take = made_takes(np.zeros(3))[0]
    assert even(take).times == pytest.approx(take.times) and even(take).rotations == pytest.approx(take.rotations)
    kept = np.r_[0:20, 23:50]
    gaps = replace(take, times=take.times[kept], rotations=take.rotations[kept], pelvis=take.pelvis[kept])
    filled = even(gaps)
    assert len(filled) == 50 and filled.times[:50] == pytest.approx(take.times[:50])
    turn = [Rotation.from_quat(one.rotations[:50].reshape(-1, 4), scalar_first=True) for one in (filled, take)]
    away = np.degrees((turn[0].inv() * turn[1]).magnitude()).reshape(50, 24).max(1)
    assert away[kept].max() < 1e-6 and 0 < away.max() < 5
    one = replace(take, times=take.times[:1], rotations=take.rotations[:1], pelvis=take.pelvis[:1])
    assert len(even(one)) == 1

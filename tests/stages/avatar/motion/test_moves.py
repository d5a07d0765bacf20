"""Motions in the world of a clip: where the person stands in them, and how fast they go."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.motion.moves import clip_move, made_move, made_moves
from stages.avatar.motion.placing import Soles
from stages.formats.body_model import read_body_model
from stages.records import Ground
from tests.made.tiny import make_poses

TILT = Rotation.from_euler("xyz", [172, 8, -5], degrees=True)  # y down, as SfM has it, and not quite level
GROUND = Ground(
    TILT.apply([1, -3, 2]), TILT.apply([0, 1, 0]), TILT.apply([0.6, 0, 0.8]), 1.0, 0.01, 0.01, 40, "as made"
)


@pytest.fixture(scope="module")
def soles():
    return Soles.of_model(read_body_model(), np.zeros(10))


def test_made_motions_start_with_a_sole_on_the_floor_where_the_person_stood(soles):
    moves = made_moves(GROUND, soles, False)
    assert [move.name for move in moves] == ["Jumping jacks", "Walk in place", "Wave", "Squats"]
    for move in moves:
        assert move.fps == pytest.approx(30) and move.rotvecs.shape == (len(move.steps), 72)
        points, joints = soles.at(move.rotvecs[:1, :3], move.rotvecs[:1, 3:], move.steps[:1])
        heights = (points[0] - GROUND.point) @ GROUND.up
        assert abs(heights.min()) < 1e-6
        assert np.linalg.norm((joints[0, 0] - GROUND.point) @ GROUND.turn[:, [0, 2]]) < 0.05
        assert Rotation.from_rotvec(move.rotvecs[0, :3]).apply([0, 0, 1]) @ GROUND.ahead > 0.98


def test_a_made_motion_has_the_length_and_rate_asked_for(soles):
    move = made_move("squats", GROUND, soles, 2.0, 12.0)
    assert move.fps == 12 and move.steps.shape == (24, 3)


@pytest.mark.parametrize(("times", "fps"), [(np.arange(8) / 10, 10), ([2, 2.5, 3, 3.5, 5, 6, 8, 9], 1), ([1] * 8, 1)])
def test_the_clip_goes_at_its_mean_rate(times, fps):
    body = make_poses()
    move = clip_move(body, np.array(times))
    assert move.fps == pytest.approx(fps)
    np.testing.assert_array_equal(move.rotvecs, np.concatenate([body.global_orient, body.body_pose], 1))
    np.testing.assert_array_equal(move.steps, body.transl)
    assert move.hands is None and clip_move(replace(body, hands=body.transl), np.array(times)).hands is body.transl
    assert move.face is None and clip_move(replace(body, face=body.transl), np.array(times)).face is body.transl

"""Motions in the world of a clip: where the person stands in them, and how fast they go."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.motion.moves import clip_move, made_moves, spot_of
from stages.avatar.motion.placing import Soles
from stages.formats.body_model import read_body_model
from stages.records import BodyPoses

TILT = Rotation.from_euler("xyz", [172, 8, -5], degrees=True)  # y down, as SfM has it, and not quite level


@pytest.fixture(scope="module")
def soles():
    return Soles.of_model(read_body_model(), np.zeros(10))


@pytest.fixture
def body(soles):
    """Someone who stands at (1, 0, 2) on a floor at height -3, in axes of their own, and looks 40 degrees to the left."""
    count = 5
    turns = TILT * Rotation.from_euler("y", np.array([[30], [35], [40], [45], [50]]), degrees=True)
    pelvis = np.array([1, -3 - soles.floor + soles.joints[0, 1], 2])
    transl = np.tile(TILT.apply(pelvis) - soles.joints[0], (count, 1))
    names = tuple(f"{i:06d}" for i in range(count))
    return BodyPoses(names, np.zeros(10), turns.as_rotvec(), np.zeros((count, 69)), transl, np.ones(count))


def test_the_spot_is_on_the_floor_below_the_person_and_looks_as_they_do(body, soles):
    spot = spot_of(body, soles)
    np.testing.assert_allclose(TILT.inv().apply(spot.place), [1, -3, 2], atol=1e-6)
    ahead = TILT * Rotation.from_euler("y", 40, degrees=True)
    np.testing.assert_allclose(spot.turn, ahead.as_matrix(), atol=1e-6)


def test_a_jump_or_a_frame_that_shows_nobody_moves_no_floor(body, soles):
    place = spot_of(body, soles).place
    up = TILT.apply([0, 1, 0])
    jumping = replace(body, transl=body.transl + np.outer([0, 0, 0.4, 0, 0], up))
    np.testing.assert_allclose(spot_of(jumping, soles).place, place, atol=1e-6)
    odd = replace(
        body,
        global_orient=body.global_orient * [[-1], [1], [1], [1], [1]],
        confidence=np.array([0.0, 1, 1, 1, 1]),
    )
    np.testing.assert_allclose(spot_of(odd, soles).place, place, atol=1e-6)


def test_made_motions_start_with_a_sole_on_the_floor_of_the_spot(body, soles):
    spot = spot_of(body, soles)
    moves = made_moves(spot, soles)
    assert [move.name for move in moves] == ["Jumping jacks", "Walk in place", "Wave", "Squats"]
    for move in moves:
        assert move.fps == pytest.approx(30) and move.rotvecs.shape == (len(move.steps), 72)
        points, joints = soles.at(move.rotvecs[:1, :3], move.rotvecs[:1, 3:], move.steps[:1])
        heights = (points[0] - spot.place) @ spot.turn[:, 1]
        assert abs(heights.min()) < 1e-6
        assert np.linalg.norm((joints[0, 0] - spot.place) @ spot.turn[:, [0, 2]]) < 0.05


@pytest.mark.parametrize(
    ("times", "fps"), [([0, 0.1, 0.2, 0.3, 0.4], 10), ([2, 2.5, 3, 3.5, 6], 1), ([1, 1, 1, 1, 1], 1)]
)
def test_the_clip_goes_at_its_mean_rate(body, times, fps):
    move = clip_move(body, np.array(times))
    assert move.fps == pytest.approx(fps)
    np.testing.assert_array_equal(move.rotvecs, np.concatenate([body.global_orient, body.body_pose], 1))
    np.testing.assert_array_equal(move.steps, body.transl)

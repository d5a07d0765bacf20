"""Fingers of other skeletons, taken over to those of the free body."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.fingers import finger_joints
from stages.avatar.body.smpl import Body
from stages.avatar.motion.hands import broken, from_bones, from_smplx, matrices
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.gestures import FINGER_NAMES, Fingers

MIDDLE = [FINGER_NAMES.index(f"right_middle{part}") for part in (1, 2, 3)]


@pytest.fixture(scope="module")
def fingers():
    model = read_body_model()
    joints, tips = finger_joints(read_hands_face(model), Body(model).rest(torch.zeros(10))[0])
    return Fingers(joints.numpy(), tips.numpy(), np.zeros((2, 15, 3)), np.zeros(0, int), np.zeros((0, 30)))


def ways_of(hands, fingers):
    """Where the right middle finger's bones point [F,3,3], as the hand sees it."""
    points = np.concatenate([fingers.joints[MIDDLE], fingers.tips[[6]]])
    local = hands.reshape(len(hands), 30, 3, 3)[:, MIDDLE]
    world = np.stack([local[:, 0], local[:, 0] @ local[:, 1], local[:, 0] @ local[:, 1] @ local[:, 2]], 1)
    ways = (world @ np.diff(points, axis=0)[..., None])[..., 0]
    return ways / np.linalg.norm(ways, axis=-1, keepdims=True)


def test_smplx_is_flat_at_0_and_a_right_angle_is_one(fingers):
    rotvecs = np.zeros((2, 2, 15, 3))
    rotvecs[1, 1, MIDDLE[1] - 15, 2] = np.pi / 2  # of a right hand, which lies along -x, towards the palm
    flat, bent = ways_of(from_smplx(rotvecs, fingers), fingers)
    assert np.abs(flat[:, 1]).max() < 1e-9 and flat[:, 0].max() < -0.95
    assert np.abs(bent[0] - flat[0]).max() < 1e-9 and bent[1:, 1].max() < -0.97


def chain(fingers, rest, bends):
    """Turns and places [1+F,5,3,3] of a skeleton: a hand, and three joints and an end of a middle finger that rests along `rest`
    [3,3] and bends by local rotations `bends` [F,3,3,3].
    """
    local = np.concatenate([np.tile(np.eye(3), (1, 3, 1, 1)), bends])
    turns, places = np.tile(np.eye(3), (len(local), 5, 1, 1)), np.zeros((len(local), 5, 3))
    for joint in (1, 2, 3):
        turns[:, joint] = turns[:, joint - 1] @ local[:, joint - 1]
        places[:, joint + 1] = places[:, joint] + turns[:, joint] @ (0.03 * rest[joint - 1])
    return turns, places, {bone: (joint, joint + 1) for joint, bone in enumerate(MIDDLE, start=1)}


def test_bones_point_where_theirs_point_however_these_rest(fingers):
    rng = np.random.default_rng(0)
    rest = rng.normal(0, 0.2, (3, 3)) + [-1, 0, 0]
    rest /= np.linalg.norm(rest, axis=1, keepdims=True)
    turns, places, bones = chain(fingers, rest, matrices(rng.normal(0, 0.5, (4, 3, 3))))
    hands = from_bones(turns, places, 0, bones, np.tile(np.eye(3), (5, 2, 1, 1)), fingers)
    theirs = (turns[1:, 1:4] @ rest[..., None])[..., 0]
    assert np.abs(ways_of(hands, fingers) - theirs).max() < 1e-9 and broken(hands, bones) == 0
    others = np.delete(hands.reshape(4, 30, 3, 3), MIDDLE, 1)
    assert np.array_equal(others, np.broadcast_to(np.eye(3), others.shape))


def test_a_bone_that_no_finger_could_turn_like_that_follows_the_one_above(fingers):
    """Converted files have fingertips that are turned back by half a turn."""
    bends = matrices(np.tile([[0.0, 0, 0.3], [0, 0, 0.3], [0, 3.0, 0]], (3, 1, 1)))
    turns, places, bones = chain(fingers, np.tile([-1.0, 0, 0], (3, 1)), bends)
    hands = from_bones(turns, places, 0, bones, np.tile(np.eye(3), (4, 2, 1, 1)), fingers)
    assert broken(hands, bones) == 1 and np.array_equal(hands[0, 1, MIDDLE[2] - 15], np.eye(3))
    assert Rotation.from_matrix(hands[0, 1, MIDDLE[0] - 15]).magnitude() > 0.03

import numpy as np
import pytest

from stages.avatar.motion.formulas import GESTURED
from stages.avatar.motion.gestures import GESTURES, ORDER, fingers_at
from stages.gestures import FACE_NAMES


@pytest.mark.parametrize("name", GESTURES)
def test_hands_and_face_go_with_the_body(name):
    hands, face = GESTURES[name](4.0, 30.0)
    orient, pose, _ = GESTURED[name](4.0, 30.0)
    assert set(GESTURES) == set(GESTURED) and len(hands) == len(face) == len(orient) == len(pose) == 120
    assert face.min() >= 0 and face.max() <= 1 and face.max(0)[FACE_NAMES.index("jawOpen")] > 0.3
    assert np.abs(np.diff(hands, axis=0)).max() < 1.2 and np.abs(np.diff(face, axis=0)).max() < 0.6


def test_fingers_open_one_after_the_other():
    """At the middle of each count as many fingers of the right hand are open, the thumb first."""
    hands, _ = GESTURES["count_to_five"](4.0, 30.0)
    bend = np.abs(hands[:, 1].reshape(-1, 5, 3, 3)[..., 1, 2])
    bend[:, 4] = np.abs(hands[:, 1].reshape(-1, 5, 3, 3)[:, 4, 1, 1])
    middles = [round(30 * (0.8 + 0.48 * (number + 0.6))) for number in range(5)]
    for count, frame in enumerate(middles, start=1):
        assert {finger for finger in range(5) if bend[frame, finger] < 0.2} == set(ORDER[:count])


def test_a_closed_hand_is_no_open_one():
    shut, wide = fingers_at(np.zeros((1, 5)), np.zeros(1)), fingers_at(np.ones((1, 5)), np.ones(1))
    assert shut[0, :12, 2].max() < -0.9 and wide[0, :12, 2].min() > 0

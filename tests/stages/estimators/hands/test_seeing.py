"""Which hands are looked at, and which looks are believed."""

from dataclasses import replace

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import pinhole
from stages.estimators.hands.seeing import LEAST, Places, looked_for, places, sure_hands
from stages.records import BodyPoses, Cameras
from tests.made.hands import MODEL, seen

SIZE = (400, 300)
WHERE = Places(
    np.array([[[100.0, 200], [300, 200]]]),
    np.array([[[100.0, 165], [300, 165]]]),
    np.array([[60.0, 60.0]]),
    np.array([[330.0, 330.0]]),
)
BOTH = [seen(100, 200), seen(300, 200)]


WHOLE = np.full((300, 400), 255, np.uint8)


def believed(left, right, where=WHERE, mask=WHOLE):
    return sure_hands([[left, right]], where, SIZE, lambda i: mask)[0].tolist()


@pytest.mark.parametrize(
    ("left", "want"),
    [
        (BOTH[0], True),
        (seen(100, 200, presence=0.6), False),  # gloved, behind the back, blurred: the network sees no hand
        (seen(100, 200, side=0.2), False),  # a right hand, or one seen from its wrong side
        (seen(135, 200), False),  # its wrist is not where the body's is
        (seen(2, 200), False),
        (seen(100, 40), False),
        (None, False),
    ],
)
def test_only_a_hand_of_that_side_at_that_wrist_is_believed(left, want):
    assert believed(left, BOTH[1]) == [want, True]


def test_a_hand_is_not_believed_whose_fingers_something_hides():
    """The hand goes up from its wrist at y = 200 to 140: of its 21 points, those the mask shows, and 6 px more, count."""
    for top, left in ((150, True), (162, True), (168, False), (200, False)):
        mask = WHOLE.copy()
        mask[:top, :200] = 0
        assert believed(*BOTH, mask=mask) == [left, True]
    assert believed(*BOTH, mask=0 * WHOLE) == [False, False]


def test_a_hand_out_of_the_picture_is_not_believed():
    near = replace(WHERE, wrists=np.array([[[100.0, 55], [300, 200]]]))
    assert believed(seen(100, 55), BOTH[1], near) == [False, True]
    assert believed(seen(100, 65), BOTH[1], near) == [True, True]


def test_of_crossed_hands_that_are_one_the_nearer_is_believed():
    near = replace(WHERE, wrists=np.array([[[150.0, 200], [165, 200]]]))
    assert believed(seen(151, 200), seen(152, 200), near) == [True, False]
    assert believed(seen(164, 200), seen(166, 200), near) == [False, True]
    assert believed(seen(145, 200), seen(165, 200), near) == [True, True]


def test_hands_are_looked_at_where_they_are_large_and_inside():
    far = replace(WHERE, lengths=np.array([[LEAST - 1.0, LEAST + 1.0]]))
    assert looked_for(far, SIZE).tolist() == [[False, True]]
    aside = replace(WHERE, roots=np.array([[[100.0, 165], [401, 165]]]))
    assert looked_for(aside, SIZE).tolist() == [[True, False]]


def test_the_bodys_hands_are_where_the_camera_sees_them():
    """A body in the T-pose 3 m away: its left hand is at the right, 18 cm long, its fingers away from the body."""
    view = np.diag([1.0, -1, -1, 1])
    view[2, 3] = 3
    poses = BodyPoses(("0",), np.zeros(10), np.zeros((1, 3)), np.zeros((1, 69)), np.zeros((1, 3)), np.ones(1))
    where = places(MODEL, poses, Cameras(("0",), view[None], pinhole(500.0, 640, 480)[None], 640, 480))
    assert where.wrists[0, 0, 0] > 420 and where.wrists[0, 1, 0] < 220
    assert np.allclose(where.lengths, 500 * 0.18 / 3, rtol=0.05)
    left, right = where.roi(0, 0), where.roi(0, 1)
    assert np.isclose(left.angle, np.pi / 2, atol=0.1) and np.isclose(right.angle, -np.pi / 2, atol=0.1)
    behind = places(
        MODEL, poses, Cameras(("0",), np.diag([1.0, -1, -1, 1])[None], pinhole(500.0, 640, 480)[None], 640, 480)
    )
    assert not looked_for(replace(behind, roots=np.full((1, 2, 2), 10.0)), (640, 480)).all()

"""The body from the side: level on its floor, the camera to the left, with a bar for what is not known."""

from __future__ import annotations

import numpy as np

from stages.estimators.bodyfit.side_view import DOUBT, FLOOR, LINE, PAPER, SKIN, TALL, side_view
from stages.records import Ground

SIDE = 240
GROUND = Ground(np.array([5.0, 1, 2]), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), 1.0, 0.01, 0.01, 100, "")
PLATE = np.array([[4.9, 1, 2], [4.9, 3, 2], [5.1, 3, 2.5], [5.1, 1, 2.5]])  # 2 m high, its right side farther away
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def drawn(expected=None, eye=(5.0, 2, -3), joint=(5.0, 2.0, 2.25)) -> np.ndarray:
    return side_view(PLATE, FACES, np.array([joint]), expected, np.array(eye), GROUND, SIDE)


def where(picture: np.ndarray, color) -> np.ndarray:
    return np.argwhere((picture == color).all(-1))


def test_it_stands_on_its_floor_at_its_size_with_the_camera_to_the_left():
    rows, columns = where(drawn(), SKIN).T
    level = SIDE * (1 - FLOOR)
    assert abs(rows.max() - level) <= 2 and abs(level - rows.min() - 2.0 * SIDE / TALL) <= 2
    assert abs(np.ptp(columns) - 0.5 * SIDE / TALL) <= 2
    assert (where(drawn(), LINE)[:, 0] == round(level)).sum() > SIDE / 2
    turned = where(drawn(eye=(5.0, 2, 8)), SKIN)[:, 1]
    assert abs((columns.min() + turned.max()) - SIDE) <= 2, "from behind it is the mirror image"


def test_a_bar_is_as_long_as_the_joint_may_be_off_and_none_is_drawn_where_nothing_is_said():
    columns = where(drawn(np.array([0.4])), DOUBT)[:, 1]
    assert abs(np.ptp(columns) - 0.8 * SIDE / TALL) <= 3
    assert not len(where(drawn(), DOUBT))


def test_a_camera_right_above_is_no_crash():
    assert (drawn(eye=(5.0, 9, 2.25))[0, 0] == PAPER).all()

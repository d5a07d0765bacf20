"""Corners keep their number from frame to frame, and are lost where they are hidden or leave."""

import numpy as np
import pytest

from stages.estimators.corners import Choice, follow
from tests.made import rooms

CHOICE = Choice(most=200, apart=5, quality=0.01, returns=0.5)


@pytest.fixture(scope="module")
def wall():
    """A wall that moves by 3 px a frame to the left."""
    picture = rooms.texture(4)[::3, ::3, 0]
    return [picture[40:160, 30 + 3 * i : 190 + 3 * i] for i in range(4)]


def test_a_corner_keeps_its_number_and_moves_with_the_wall(wall):
    found = follow(((grey, np.ones(grey.shape, bool)) for grey in wall), CHOICE)
    both, i, j = np.intersect1d(found[0][0], found[3][0], return_indices=True)
    assert len(both) > 50
    np.testing.assert_allclose(np.median(found[3][1][j] - found[0][1][i], axis=0), [-9, 0], atol=0.1)
    assert all(len(np.unique(rows)) == len(rows) for rows, _ in found)


def test_hidden_corners_are_lost_and_never_come_back_with_their_number(wall):
    shown = [np.ones(grey.shape, bool) for grey in wall]
    shown[1][:, :80] = False
    found = follow(zip(wall, shown), CHOICE)
    assert (found[1][1][:, 0] >= 79).all()
    left = found[0][0][found[0][1][:, 0] < 70]
    assert len(left) and not np.isin(left, found[2][0]).any()


def test_at_most_so_many_are_followed_and_a_plain_picture_has_none(wall):
    few = Choice(most=20, apart=5, quality=0.01, returns=0.5)
    assert all(10 < len(rows) <= 20 for rows, _ in follow(((g, np.ones(g.shape, bool)) for g in wall), few))
    plain = np.full((60, 60), 90, np.uint8)
    assert [len(rows) for rows, _ in follow([(plain, np.ones(plain.shape, bool))] * 2, CHOICE)] == [0, 0]

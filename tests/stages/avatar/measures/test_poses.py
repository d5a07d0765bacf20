"""Which of the held-out frames show poses that training has not seen."""

import numpy as np
import pytest

from stages.avatar.measures.poses import farthest


def bent(*angles: float) -> np.ndarray:
    """Poses [F,69] whose left knee is bent."""
    poses = np.zeros((len(angles), 69))
    poses[:, 9] = angles
    return poses


def test_the_third_that_is_farthest_from_the_nearest_seen_pose_is_chosen():
    poses, seen = bent(0, 0.1, 0.5, 0.55, 1.4, 0.9), np.array([1, 0, 1, 0, 0, 0], bool)
    assert farthest(poses, [1, 3, 4], seen) == [4]
    assert farthest(poses, [1, 3, 4, 5], seen) == [4] and farthest(poses, [1, 3, 5], seen) == [5]
    assert farthest(bent(*np.linspace(0, 1, 7)), [6, 1, 2, 3, 4, 5], np.arange(7) == 0) == [6, 5]


def test_a_full_turn_more_is_the_same_pose():
    poses = bent(0.3, 0.3 + 2 * np.pi, 0.4)
    assert farthest(poses, [1, 2], np.array([1, 0, 0], bool)) == [2]


@pytest.mark.parametrize(("asked", "seen"), [([], [1, 1]), ([0, 1], [0, 0])])
def test_where_nothing_is_asked_or_seen_none_is(asked, seen):
    assert farthest(bent(0, 1), asked, np.array(seen, bool)) == []

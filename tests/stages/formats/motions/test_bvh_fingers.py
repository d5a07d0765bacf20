import numpy as np
import pytest

from stages.formats.motions.bvh import Bvh
from stages.formats.motions.bvh_fingers import map_fingers
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES
from tests.made.fingers import FAMILIES, skeleton


@pytest.mark.parametrize("family", FAMILIES)
def test_fingers_are_known_by_the_names_of_many_programs(family):
    (index, thumb), (names, parents) = FAMILIES[family], skeleton(family)
    count = len(names)
    bvh = Bvh(tuple(names), np.array(parents), np.zeros((1, count, 3)), np.zeros((1, count, 3, 3)), 30.0)
    found = map_fingers(bvh, {JOINT_NAMES.index("left_wrist"): 1, JOINT_NAMES.index("right_wrist"): 2})
    inside = [name for name in index if not any(word in name.lower() for word in ("inhand", "metacarpal", "palm"))][:3]
    wanted = {f"left_index{part}": name for part, name in enumerate(inside, 1)}
    wanted |= {f"left_thumb{part}": name for part, name in enumerate(thumb, 1)}
    assert {FINGER_NAMES[bone]: names[start] for bone, (start, _) in found.items()} == wanted
    assert all(parents[end] == start for start, end in found.values())


def test_a_thumb_of_another_hand_or_of_none_is_not_taken():
    names = ("Hips", "LeftHand", "RightHand", "LeftThumb1", "")
    bvh = Bvh(names, np.array([-1, 0, 0, 2, 3]), np.zeros((1, 5, 3)), np.zeros((1, 5, 3, 3)), 30.0)
    assert map_fingers(bvh, {JOINT_NAMES.index("left_wrist"): 1, JOINT_NAMES.index("right_wrist"): 2}) == {}

import numpy as np
import pytest

from stages.formats.motions.bvh import Bvh
from stages.formats.motions.bvh_fingers import map_fingers
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES

FAMILIES = {  # how a left index is called, from the palm on, and a left thumb
    "Mixamo": (
        ["LeftHandIndex1", "LeftHandIndex2", "LeftHandIndex3", "LeftHandIndex4"],
        ["LeftHandThumb1", "LeftHandThumb2"],
    ),
    "Neuron": (
        ["LeftInHandIndex", "LeftHandIndex1", "LeftHandIndex2", "LeftHandIndex3"],
        ["LeftHandThumb1", "LeftHandThumb2"],
    ),
    "Rokoko": (
        ["LeftFinger2Metacarpal", "LeftFinger2Proximal"],
        ["LeftFinger1Metacarpal", "LeftFinger1Proximal"],
    ),
    "Rigify": (["palm_index.L", "f_index.01.L", "f_index.02.L", "f_index.03.L"], ["thumb.01.L", "thumb.02.L"]),
    "MakeHuman": (["metacarpal1.L", "finger2-1.L", "finger2-2.L"], ["finger1-1.L", "finger1-2.L"]),
    "Unreal": (["index_metacarpal_l", "index_01_l", "index_02_l"], ["thumb_01_l", "thumb_02_l"]),
    "Biped": (["Bip01 L Finger1", "Bip01 L Finger11", "Bip01 L Finger12"], ["Bip01 L Finger0", "Bip01 L Finger01"]),
    "VRM": (
        ["leftIndexProximal", "leftIndexIntermediate", "leftIndexDistal"],
        ["leftThumbMetacarpal", "leftThumbProximal"],
    ),
    "SMPL-X": (["left_index1", "left_index2", "left_index3"], ["left_thumb1", "left_thumb2"]),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_fingers_are_known_by_the_names_of_many_programs(family):
    index, thumb = FAMILIES[family]
    names, parents = ["Hips", "LeftHand", "RightHand"], [-1, 0, 0]
    for chain in (index, thumb):
        for place, name in enumerate([*chain, ""]):
            parents.append(len(names) - 1 if place else 1)
            names.append(name)
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

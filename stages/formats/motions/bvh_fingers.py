"""Which joints of a BVH skeleton are fingers: by their names, and by their order from the hand on."""

from __future__ import annotations

import re
from collections.abc import Mapping

from stages.formats.motions.bvh import Bvh
from stages.formats.motions.bvh_names import words_of
from stages.formats.motions.bvh_tree import ancestors
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES

FINGERS = {"thumb": "thumb", "index": "index", "middle": "middle", "mid": "middle", "ring": "ring"}
FINGERS |= {"pinky": "pinky", "pinkie": "pinky", "little": "pinky"}
NUMBERED = ("thumb", "index", "middle", "ring", "pinky")
"""Fingers by number, from 1 on (Rokoko, MakeHuman), or from 0 on where there is one (Biped)."""
PALM = ("inhand", "metacarpal", "palm")  # of what lies in the palm; a thumb begins there
_FINGER = re.compile(rf"finger(\d)|({'|'.join(FINGERS)})")


def map_fingers(bvh: Bvh, limbs: Mapping[int, int]) -> dict[int, tuple[int, int]]:
    """Bones, numbered as FINGER_NAMES, and the joints at which theirs begin and end; `limbs` are those of `BodyMap`.

    Families: Mixamo and MotionBuilder (LeftHandIndex1), Rokoko (LeftFinger2Proximal), Rigify (f_index.01.L), MakeHuman
    (finger2-1.L), Unreal (index_01_l), Biped (Bip01 L Finger1), VRM (leftIndexProximal), SMPL-X (left_index1).
    """
    parents = bvh.parents.tolist()
    below = {parent: joint for joint, parent in reversed(list(enumerate(parents)))}
    found: dict[tuple[str, str], list[int]] = {}
    for joint, name in enumerate(bvh.names):
        side, plain = words_of(name)
        match = _FINGER.search(plain)
        if side and match and limbs[JOINT_NAMES.index(f"{side}_wrist")] in ancestors(parents, joint)[:-1]:
            found.setdefault((side, match[1] or FINGERS[match[2]]), []).append(joint)
    from_none = any(finger == "0" for _, finger in found)
    chains = {}
    for (side, finger), joints in found.items():
        if finger.isdigit():
            number = int(finger) - (not from_none)
            if not 0 <= number < len(NUMBERED):
                continue
            finger = NUMBERED[number]
        outside = [
            joint for joint in joints if finger == "thumb" or not any(word in bvh.names[joint].lower() for word in PALM)
        ]
        for part, joint in enumerate(outside[:3], start=1):
            if joint in below:
                chains[FINGER_NAMES.index(f"{side}_{finger}{part}")] = (joint, below[joint])
    return chains

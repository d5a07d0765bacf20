"""SMPL's joints as indices into `records.JOINT_NAMES`; paired joints as (left, right)."""

from __future__ import annotations

from stages.records import JOINT_NAMES


def _pair(part: str) -> tuple[int, int]:
    return JOINT_NAMES.index(f"left_{part}"), JOINT_NAMES.index(f"right_{part}")


HIPS, KNEES, ANKLES, FEET = _pair("hip"), _pair("knee"), _pair("ankle"), _pair("foot")
COLLARS, SHOULDERS, ELBOWS = _pair("collar"), _pair("shoulder"), _pair("elbow")
WRISTS, HANDS = _pair("wrist"), _pair("hand")
SPINE = JOINT_NAMES.index("spine1"), JOINT_NAMES.index("spine2"), JOINT_NAMES.index("spine3")
NECK, HEAD = JOINT_NAMES.index("neck"), JOINT_NAMES.index("head")

"""What other programs call the joints of `records.JOINT_NAMES`, so that their retargeters know them."""

from __future__ import annotations

from typing import Literal, get_args

from stages.records import JOINT_NAMES

Names = Literal["smpl", "mixamo", "vrm"]
_MIDDLE = {
    "pelvis": ("Hips", "hips"),
    "spine1": ("Spine", "spine"),
    "spine2": ("Spine1", "chest"),
    "spine3": ("Spine2", "upperChest"),
    "neck": ("Neck", "neck"),
    "head": ("Head", "head"),
}
_SIDE = {
    "hip": ("UpLeg", "UpperLeg"),
    "knee": ("Leg", "LowerLeg"),
    "ankle": ("Foot", "Foot"),
    "foot": ("ToeBase", "Toes"),
    "collar": ("Shoulder", "Shoulder"),
    "shoulder": ("Arm", "UpperArm"),
    "elbow": ("ForeArm", "LowerArm"),
    "wrist": ("Hand", "Hand"),
    "hand": ("HandMiddle1", "MiddleProximal"),
}
"""Part -> Mixamo's and VRM 1.0's name. What SMPL calls a hand is where its fingers begin."""


def bone_names(names: Names) -> tuple[str, ...]:
    """The 24 joints' names in the order of JOINT_NAMES."""
    if names == "smpl":
        return JOINT_NAMES
    column = get_args(Names).index(names) - 1
    found = []
    for joint in JOINT_NAMES:
        side, _, part = joint.rpartition("_")
        name = (_SIDE if side else _MIDDLE)[part][column]
        found.append(f"mixamorig:{side.title()}{name}" if names == "mixamo" else f"{side}{name}")
    return tuple(found)

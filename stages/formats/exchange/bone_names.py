"""What other programs call the joints of `records.JOINT_NAMES`, so that their retargeters know them."""

from __future__ import annotations

from typing import Literal, get_args

from stages.records import JOINT_NAMES

Names = Literal["smpl", "mixamo", "vrm", "unreal"]
_PARTS = {
    "pelvis": ("Hips", "hips", "pelvis"),
    "spine1": ("Spine", "spine", "spine_01"),
    "spine2": ("Spine1", "chest", "spine_02"),
    "spine3": ("Spine2", "upperChest", "spine_03"),
    "neck": ("Neck", "neck", "neck_01"),
    "head": ("Head", "head", "head"),
    "hip": ("UpLeg", "UpperLeg", "thigh"),
    "knee": ("Leg", "LowerLeg", "calf"),
    "ankle": ("Foot", "Foot", "foot"),
    "foot": ("ToeBase", "Toes", "ball"),
    "collar": ("Shoulder", "Shoulder", "clavicle"),
    "shoulder": ("Arm", "UpperArm", "upperarm"),
    "elbow": ("ForeArm", "LowerArm", "lowerarm"),
    "wrist": ("Hand", "Hand", "hand"),
    "hand": ("HandMiddle1", "MiddleProximal", "middle_01"),
}
"""Part -> the name in Mixamo, VRM 1.0 and Unreal's mannequin. What SMPL calls a hand is where its fingers begin."""


def bone_names(names: Names) -> tuple[str, ...]:
    """The 24 joints' names in the order of JOINT_NAMES."""
    if names == "smpl":
        return JOINT_NAMES
    column = get_args(Names).index(names) - 1
    found = []
    for joint in JOINT_NAMES:
        side, _, part = joint.rpartition("_")
        name = _PARTS[part][column]
        if names == "mixamo":
            found.append(f"mixamorig:{side.title()}{name}")
        else:
            found.append(f"{side}{name}" if names == "vrm" else f"{name}_{side[:1]}".rstrip("_"))
    return tuple(found)

"""What other programs call the joints of `records.JOINT_NAMES`, so that their retargeters know them."""

from __future__ import annotations

from typing import Literal, get_args

from stages.gestures import FINGER_NAMES
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


_PALM = ("HandPalm", "Palm", "palm")
"""What SMPL calls a hand where fingers have bones of their own: these programs know no bone between hand and fingers."""
_FINGERS = {
    "index": ("HandIndex", "Index", "index"),
    "middle": ("HandMiddle", "Middle", "middle"),
    "pinky": ("HandPinky", "Little", "pinky"),
    "ring": ("HandRing", "Ring", "ring"),
    "thumb": ("HandThumb", "Thumb", "thumb"),
}
_VRM_BONES = ("Proximal", "Intermediate", "Distal")
_VRM_THUMB = ("Metacarpal", "Proximal", "Distal")


def finger_names(names: Names) -> tuple[str, ...]:
    """The 30 finger bones' names in the order of FINGER_NAMES."""
    if names == "smpl":
        return FINGER_NAMES
    column, found = get_args(Names).index(names) - 1, []
    for bone in FINGER_NAMES:
        side, finger, part = bone.partition("_")[0], bone.partition("_")[2][:-1], int(bone[-1])
        name = _FINGERS[finger][column]
        vrm = (_VRM_THUMB if finger == "thumb" else _VRM_BONES)[part - 1]
        kinds = (f"mixamorig:{side.title()}{name}{part}", f"{side}{name}{vrm}", f"{name}_{part:02d}_{side[:1]}")
        found.append(kinds[column])
    return tuple(found)


def bone_names(names: Names, fingers: bool = False) -> tuple[str, ...]:
    """The 24 joints' names in the order of JOINT_NAMES; with `fingers`, which have names of their own, hands are palms."""
    if names == "smpl":
        return JOINT_NAMES
    column = get_args(Names).index(names) - 1
    found = []
    for joint in JOINT_NAMES:
        side, _, part = joint.rpartition("_")
        name = (_PALM if fingers and part == "hand" else _PARTS[part])[column]
        if names == "mixamo":
            found.append(f"mixamorig:{side.title()}{name}")
        else:
            found.append(f"{side}{name}" if names == "vrm" else f"{name}_{side[:1]}".rstrip("_"))
    return tuple(found)

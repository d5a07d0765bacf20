"""Fingers of other skeletons: what nine families of programs call them, and a motion of all thirty, as a BVH."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from stages.avatar.drawing.avatar import load_avatar
from stages.avatar.drawing.rig import rig_of
from stages.avatar.drawing.takes import hung
from stages.avatar.motion.takes import take_of
from stages.formats.exchange.bone_names import Names
from stages.formats.exchange.motion_bvh import write_motion_bvh
from stages.records import Avatar

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


def skeleton(family: str) -> tuple[list[str], list[int]]:
    """Names and parents of hips, both hands, and of a family's left index and thumb, which end in an End Site, ""."""
    names, parents = ["Hips", "LeftHand", "RightHand"], [-1, 0, 0]
    for chain in FAMILIES[family]:
        for place, name in enumerate([*chain, ""]):
            parents.append(len(names) - 1 if place else 1)
            names.append(name)
    return names, parents


def write_waving(path: Path, avatar: Avatar, names: Names, frames: int = 12) -> Path:
    """A BVH in which the whole body and all fingers of `avatar` move at random, under the names of a program."""
    rng = np.random.default_rng(4)
    orient, pose = rng.normal(0, 0.1, (frames, 3)), rng.normal(0, 0.2, (frames, 69))
    hands = rng.normal(0, 0.35, (frames, 2, 15, 3))
    pelvis = avatar.joints[0] + rng.normal(0, 0.02, (frames, 3))
    take = take_of("waving", np.arange(frames) / 25, orient, pose, pelvis, hands)
    write_motion_bvh(path, rig_of(avatar), hung(load_avatar(avatar), take), names)
    return path


def renamed(text: str, family: str) -> str:
    """A BVH with Mixamo's names, with those of Rokoko or Rigify for its fingers."""
    fingers = ("Thumb", "Index", "Middle", "Ring", "Pinky")
    bones = ("Proximal", "Medial", "Distal")

    def call(found: re.Match[str]) -> str:
        side, finger, part = found[1], found[2], int(found[3])
        if family == "Rokoko":
            return f"{side}Finger{fingers.index(finger) + 1}{bones[part - 1]}"
        return f"{'' if finger == 'Thumb' else 'f_'}{finger.lower()}.{part:02d}.{side[0]}"

    return re.sub(r"mixamorig:(Left|Right)Hand(\w+?)([123])\b", call, text)

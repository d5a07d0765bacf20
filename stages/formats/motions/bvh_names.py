"""Which joint of a BVH skeleton is which of SMPL's: limbs by their names, the trunk by what connects them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from stages.contract import StageError
from stages.formats.motions.bvh import Bvh
from stages.records import JOINT_NAMES

SYNONYMS = {  # SMPL's joint: what others call it, the clearest word first; claimed in this order, each joint once
    "hip": "upleg upperleg thigh hip",
    "knee": "lowerleg loleg shin calf knee leg",
    "ankle": "ankle foot",
    "foot": "toebase toe toes toe0 ball foot",
    "shoulder": "upperarm uparm arm shldr shoulder",
    "elbow": "forearm lowerarm loarm elbow",
    "wrist": "wrist hand",
    "collar": "collar clavicle shoulder",
}
"""Families: MotionBuilder and Mixamo (LeftUpLeg), CMU (LeftHip), Biped (Bip01 L Thigh), Rigify (thigh.L), Unreal
(thigh_l), Poser (lThigh, lShldr), SMPL (L_Hip, where the foot is what others call the toes)."""
NEEDED = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
HINT = "rename the joints as Mixamo does: Hips, LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, LeftHand, Head"


@dataclass(frozen=True)
class BodyMap:
    """Joints of a BVH by number.

    `limbs`: SMPL joint -> joint. `pelvis` is where both legs meet; `spine` goes from there (left out) to where both
    arms meet, `neck` from there (left out) to the head; either may be empty. `used` counts all these, `unused` are the names
    of the others.
    """

    limbs: dict[int, int]
    pelvis: int
    spine: tuple[int, ...]
    neck: tuple[int, ...]
    used: int
    unused: tuple[str, ...]


def map_body(bvh: Bvh, path: Path) -> BodyMap:
    """Find the body in a skeleton; StageError with the names found where a leg or an arm is missing."""
    words = {_words(name): i for i, name in reversed(list(enumerate(bvh.names))) if name}
    limbs: dict[int, int] = {}
    missing: list[str] = []
    for side in ("left", "right"):
        for part, names in SYNONYMS.items():
            found = [
                words[side, name] for name in names.split() if words.get((side, name)) not in (None, *limbs.values())
            ]
            if found:
                limbs[JOINT_NAMES.index(f"{side}_{part}")] = found[0]
            elif part in NEEDED:
                missing.append(f"{side} {part}")
    if missing:
        facts = [f"missing: {', '.join(missing)}", f"joints: {', '.join(filter(None, bvh.names))}"]
        raise StageError(f"no person's legs and arms in {path}", HINT, facts)
    up = {i: _ancestors(bvh, i) for i in range(len(bvh.names))}
    left, right = (limbs[JOINT_NAMES.index(f"{side}_hip")] for side in ("left", "right"))
    pelvis = _meet(up[left], up[right])
    chest = _meet(*(up[limbs[JOINT_NAMES.index(f"{side}_shoulder")]] for side in ("left", "right")))
    head = words.get(("", "head"), chest)
    spine, neck = _path(up[pelvis], up[chest]), _path(up[chest], up[head])
    used = {*limbs.values(), pelvis, *spine, *neck}
    unused = tuple(name for i, name in enumerate(bvh.names) if name and i not in used)
    return BodyMap(limbs, pelvis, spine, neck, len(used), unused)


def _words(name: str) -> tuple[str, str]:
    """Side ("left", "right" or "") and what is left of a joint's name: "mixamorig:LeftUpLeg" -> ("left", "upleg")."""
    name = re.sub(r"^(bip\d*|mixamorig\d*|def|org)[\s_.-]+", "", name.rpartition(":")[2], flags=re.IGNORECASE)
    for side, letter in (("left", "l"), ("right", "r")):
        for pattern in (
            rf"^{side}[\s_.-]*(.+)$",
            rf"^(.+?)[\s_.-]*{side}$",
            rf"^{letter}[\s_.-]+(.+)$",
            rf"^(.+?)[\s_.-]+{letter}$",
        ):
            if match := re.match(pattern, name, flags=re.IGNORECASE):
                return side, _plain(match[1])
        if match := re.match(rf"^[{letter}{letter.upper()}]([A-Z].*)$", name):
            return side, _plain(match[1])
    return "", _plain(name)


def _plain(text: str) -> str:
    return re.sub(r"[\s_.-]", "", text).lower()


def _ancestors(bvh: Bvh, joint: int) -> list[int]:
    """The joints from the root down to `joint`, both included."""
    line = [joint]
    while bvh.parents[line[0]] >= 0:
        line.insert(0, int(bvh.parents[line[0]]))
    return line


def _meet(a: list[int], b: list[int]) -> int:
    """The last joint that two root chains share."""
    return [x for x, y in zip(a, b) if x == y][-1]


def _path(start: list[int], end: list[int]) -> tuple[int, ...]:
    """The joints of `end` after those of `start`."""
    return tuple(joint for joint in end if joint not in start)

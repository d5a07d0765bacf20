"""Which joint of a BVH skeleton is which of SMPL's: limbs by their names, the trunk by what connects them.

Where names do not say it, or say what the tree cannot be, the tree does: see `bvh_tree.py`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from stages.contract import StageError
from stages.formats.motions.bvh import Bvh
from stages.formats.motions.bvh_tree import ancestors, by_tree
from stages.records import JOINT_NAMES

SYNONYMS = {  # SMPL's joint: what others call it, the clearest word first; claimed in this order, each joint once
    "hip": "upleg upperleg thigh hip",
    "knee": "lowerleg loleg shin calf knee leg",
    "ankle": "ankle foot",
    "foot": "toebase toe toes toe0 ball foot",
    "shoulder": "upperarm uparm arm shldr shoulder",
    "elbow": "forearm lowerarm lowarm loarm elbow",
    "wrist": "wrist hand",
    "collar": "collar clavicle shoulder",
}
"""Families: MotionBuilder and Mixamo (LeftUpLeg), CMU (LeftHip), Biped (Bip01 L Thigh), Rigify (thigh.L), Unreal
(thigh_l), Poser (lThigh, lShldr), SMPL (L_Hip, where the foot is what others call the toes)."""
NEEDED = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
LISTED = 400  # letters of the names that an error lists
HINT = "rename the joints as Mixamo does: Hips, LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, LeftHand, Head"


@dataclass(frozen=True)
class BodyMap:
    """Joints of a BVH by number.

    `limbs`: SMPL joint -> joint. `pelvis` is where both legs meet; `spine` goes from there (left out) to where both
    arms meet, `neck` from there (left out) to the head; either may be empty. `used` counts all these, `unused` are the names
    of the others. `said`: how limbs were found where their names did not say it.
    """

    limbs: dict[int, int]
    pelvis: int
    spine: tuple[int, ...]
    neck: tuple[int, ...]
    used: int
    unused: tuple[str, ...]
    said: tuple[str, ...] = ()


def map_body(bvh: Bvh, path: Path) -> BodyMap:
    """Find the body in a skeleton; StageError with the names found where a leg or an arm is missing."""
    words = {words_of(name): i for i, name in reversed(list(enumerate(bvh.names))) if name}
    parents = bvh.parents.tolist()
    limbs, missing = _by_names(words)
    head = words.get(("", "head"))
    said: tuple[str, ...] = ()
    if missing or not _outwards(limbs, parents):
        found = by_tree(bvh, lambda name: words_of(name)[0])
        if found is None:
            facts = [f"missing: {', '.join(missing) or 'none, but they do not hang on each other'}"]
            facts.append(f"joints: {', '.join(filter(None, bvh.names))[:LISTED]}")
            raise StageError(f"no person's legs and arms in {path}", HINT, facts)
        limbs, head = found.limbs, found.head if head is None else head
        said = (_told(limbs, bvh, found.sides),)
    up = {i: ancestors(parents, i) for i in {*limbs.values(), *([] if head is None else [head])}}
    left, right = (limbs[JOINT_NAMES.index(f"{side}_hip")] for side in ("left", "right"))
    pelvis = _meet(up[left], up[right])
    chest = _meet(*(up[limbs[JOINT_NAMES.index(f"{side}_shoulder")]] for side in ("left", "right")))
    up |= {i: ancestors(parents, i) for i in (pelvis, chest)}
    spine, neck = _path(up[pelvis], up[chest]), _path(up[chest], up[chest if head is None else head])
    used = {*limbs.values(), pelvis, *spine, *neck}
    unused = tuple(name for i, name in enumerate(bvh.names) if name and i not in used)
    return BodyMap(limbs, pelvis, spine, neck, len(used), unused, said)


def _by_names(words: Mapping[tuple[str, str], int]) -> tuple[dict[int, int], list[str]]:
    """SMPL joint -> joint of the limbs, and which needed ones have no name."""
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
    return limbs, missing


def _outwards(limbs: Mapping[int, int], parents: list[int]) -> bool:
    """Whether each arm and leg goes on outwards, as the tree has it."""
    for side in ("left", "right"):
        for chain in (NEEDED[:3], NEEDED[3:]):
            inner, middle, outer = (limbs[JOINT_NAMES.index(f"{side}_{part}")] for part in chain)
            line = ancestors(parents, outer)
            if inner not in line or middle not in line or line.index(inner) >= line.index(middle):
                return False
    return True


def _told(limbs: Mapping[int, int], bvh: Bvh, sides: str) -> str:
    parts = [f"left {part} {bvh.names[limbs[JOINT_NAMES.index(f'left_{part}')]] or 'end'}" for part in NEEDED]
    return f"unknown names of joints: taken by the tree, left and right by {sides}: {', '.join(parts)}"


def words_of(name: str) -> tuple[str, str]:
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


def _meet(a: list[int], b: list[int]) -> int:
    """The last joint that two root chains share."""
    return [x for x, y in zip(a, b) if x == y][-1]


def _path(start: list[int], end: list[int]) -> tuple[int, ...]:
    """The joints of `end` after those of `start`."""
    return tuple(joint for joint in end if joint not in start)

"""Skeletons of keypoint networks: which of their points are BlazePose's 33, by name or by place in a list.

Sources: OpenPose doc/02_output.md, COCO-WholeBody, Halpe-FullBody, MediaPipe's pose landmarks, Human3.6M as mmpose orders it,
easy_ViTPose vit_utils/visualization.py, sam_3d_body/metadata/mhr70.py (the first of Sapiens' 308 too).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from stages.contract import StageError
from stages.formats.landmarks import NAMES

ORDERED = 1.0
"""`disorder` up to which points are in an order: 0.4 to 0.65 for courtyard's person, 0.9 to 2 in other orders."""
LONG = 90  # percentile of a bone's lengths
LEAST = 6  # points with names of ours


def _both(*parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts for side in ("left", "right"))


def _line(side: str, *parts: str) -> tuple[str, ...]:
    return tuple(part and f"{side}_{part}" for part in parts)


def _none(count: int) -> tuple[str, ...]:
    return ("",) * count


def _hand(side: str) -> tuple[str, ...]:
    """A root, then four points of thumb, index, middle and ring finger, little finger, from the knuckles outwards."""
    return (*_none(5), f"{side}_index", *_none(11), f"{side}_pinky", *_none(3))


def _finger_ends(side: str) -> tuple[str, ...]:
    """Four points of each finger from the tips inwards, and the wrist."""
    return (*_none(7), f"{side}_index", *_none(11), f"{side}_pinky", f"{side}_wrist")


_ARM, _LEG, _SOLE = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"), ("foot_index", "", "heel")
_FEET = (*_line("left", *_SOLE), *_line("right", *_SOLE))
_HANDS = (*_hand("left"), *_hand("right"))
_COCO = ("nose", *_both("eye", "ear", *_ARM, *_LEG))
_ARMS, _LEGS = ((*_line("right", *parts), *_line("left", *parts)) for parts in (_ARM, _LEG))
_FACE = ("right_eye", "left_eye", "right_ear", "left_ear")
_BODY_25 = ("nose", "", *_ARMS, "", *_LEGS, *_FACE, *_FEET)
_COCO_18 = ("nose", "", *_ARMS, *_LEGS, *_FACE)
_HALPE = (*_COCO, *_none(3), *_both("foot_index"), *_none(2), *_both("heel"))
_MHR = (
    *("nose", *_both("eye", "ear", "shoulder", "elbow", *_LEG), *_FEET),
    *(*_finger_ends("right"), *_finger_ends("left"), *_none(7)),
)
SKELETONS = {
    "COCO-17": _COCO,
    "Human3.6M": ("", *_LEGS, *_none(4), *_line("left", *_ARM), *_line("right", *_ARM)),
    "OpenPose COCO-18": _COCO_18,
    "COCO-23": (*_COCO, *_FEET),
    "OpenPose BODY_25": _BODY_25,
    "OpenPose BODY_25B": (*_COCO, *_none(2), *_FEET),
    "ViTPose COCO-25": (
        *(*_COCO[:5], "", *_both(*_ARM, "hip"), "", *_both("knee", "ankle")),
        *_FEET,
    ),
    "Halpe-26": _HALPE,
    "BlazePose-33": NAMES,
    "OpenPose COCO-18 and hands": (*_COCO_18, *_HANDS),
    "OpenPose BODY_25 and hands": (*_BODY_25, *_HANDS),
    "MHR-70": _MHR,
    "COCO-WholeBody-133": (*_COCO, *_FEET, *_none(68), *_HANDS),
    "Halpe-136": (*_HALPE, *_none(68), *_HANDS),
    "Sapiens-308": (*_MHR, *_none(238)),
}
_LIMBS = (
    *(("shoulder", "elbow", 0.17), ("elbow", "wrist", 0.15), ("shoulder", "hip", 0.29), ("hip", "knee", 0.24)),
    *(("knee", "ankle", 0.24), ("ankle", "foot_index", 0.12), ("ear", "shoulder", 0.15)),
)
_ACROSS = (("shoulder", 0.2), ("hip", 0.12), ("eye", 0.035), ("ear", 0.08))
BONES = tuple(
    (NAMES.index(a), NAMES.index(b), length)
    for a, b, length in (
        *((f"{side}_{a}", f"{side}_{b}", length) for side in ("left", "right") for a, b, length in _LIMBS),
        *((f"left_{part}", f"right_{part}", length) for part, length in _ACROSS),
    )
)
"""Places of two points, and how far they are apart as a share of the stature."""
PARTS = {
    **{
        part: part
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "ear", "eye", "index", "pinky")
    },
    **dict.fromkeys(("footindex", "bigtoe", "bigtoetip"), "foot_index"),
    **dict.fromkeys(("index1", "forefinger1", "forefingerthirdjoint", "indexthirdjoint"), "index"),
    **dict.fromkeys(("pinky1", "pinkyfinger1", "pinkyfingerthirdjoint", "pinkythirdjoint"), "pinky"),
}
"""How programs call the parts of a side -> how BlazePose does."""


def our_name(name: str) -> str:
    """BlazePose's name of a point that another program calls RHip, left-hip, l_hip, hip_right or leftHip; "" if it has none."""
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    parts = [part for part in re.split(r"[^a-z0-9]+", words.lower()) if part]
    if parts == ["nose"]:
        return "nose"
    sides = [part for part in parts if part in ("l", "r", "left", "right")]
    joined = "".join(part for part in parts if part not in sides)
    if not sides and (found := re.fullmatch(r"(left|right|l|r)([a-z0-9]+)", joined)):
        sides, joined = [found[1]], found[2]
    if len(sides) != 1 or joined not in PARTS:
        return ""
    return f"{'left' if sides[0].startswith('l') else 'right'}_{PARTS[joined]}"


def recognise(points: np.ndarray, names: Sequence[str] | None, path: str) -> tuple[str, np.ndarray]:
    """The skeleton of `points` [N,K,2 or 3] (NaN: unknown), and of BlazePose's 33 points the place among the K, -1 for none.

    By `names` where the file has them; else by K and, of several skeletons, by whose bones are most like a person's. StageError
    for names or a number that no skeleton has, and for points that are in no skeleton's order.
    """
    if names is not None:
        places = places_of([our_name(name) for name in names])
        if (places >= 0).sum() < LEAST:
            facts = [f"of {len(names)} names {(places >= 0).sum()} are known: {', '.join(map(str, names[:12]))}"]
            raise StageError(
                f"{path} does not name the joints of a person", "name them left_shoulder, RKnee ...", facts
            )
        return f"{(places >= 0).sum()} named points", places
    fitting = {name: places_of(order) for name, order in SKELETONS.items() if len(order) == points.shape[1]}
    if not fitting:
        known = ", ".join(f"{len(order)} ({name})" for name, order in SKELETONS.items())
        facts = [f"it has {points.shape[1]} points; known are {known}"]
        raise StageError(f"{path} holds the points of no known skeleton", "give a file that names its points", facts)
    found = {name: disorder(points, places) for name, places in fitting.items()}
    best = min(found, key=lambda name: found[name])
    if found[best] > ORDERED:
        facts = [f"as {name} its bones are unlike a person's by {how:.1f}" for name, how in found.items()]
        facts.append(f"in the right order it is 0.4 to 0.7, up to {ORDERED:g} is taken")
        hint = "write the points in the order of the network, or with their names"
        raise StageError(f"the points of {path} are in the order of no known skeleton", hint, facts)
    return best, fitting[best]


def places_of(order: Sequence[str]) -> np.ndarray:
    """The place [33] of each of BlazePose's points in an order of names, -1 for none."""
    return np.array([order.index(name) if name in order else -1 for name in NAMES])


def disorder(points: np.ndarray, places: np.ndarray) -> float:
    """How unlike a person's the bones between points [N,K,2 or 3] are: their length over the mean distance of any two points, and
    the mean logarithm by which their proportions, where they are least foreshortened, are off; 0 where none is known."""
    ours = np.where((places >= 0)[:, None], points[:, places], np.nan)
    pairs = np.array(list(combinations(np.flatnonzero(places >= 0), 2)))
    bones = np.array([(a, b) for a, b, _ in BONES if places[a] >= 0 and places[b] >= 0])
    wanted = np.array([length for a, b, length in BONES if places[a] >= 0 and places[b] >= 0])
    apart, length = (np.linalg.norm(ours[:, ends[:, 0]] - ours[:, ends[:, 1]], axis=-1) for ends in (pairs, bones))
    rows = np.isfinite(length).any(1)
    if not rows.any():
        return 0.0
    sprawl = np.median(np.nanmean(length[rows], 1) / np.maximum(np.nanmean(apart[rows], 1), 1e-9))
    seen = np.isfinite(length).any(0)
    ratio = np.log(np.maximum(np.nanpercentile(length[:, seen], LONG, axis=0), 1e-9) / wanted[seen])
    return float(sprawl + np.abs(ratio - np.median(ratio)).clip(max=2).mean())

"""Which joint is which where names do not say it: legs and arms are the two pairs of long limbs that a skeleton has twice.

A limb is the longest way down from a joint. Two that begin at one joint with bones of the same lengths are a pair; the legs
are the one that begins nearer to the root. Of a leg, thigh and shin are nearly as long and most of it; of an arm, the bones are
as long as arms have them beside such legs; knees and elbows bend in the motion, joints for twist do not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from stages.formats.motions.bvh import Bvh
from stages.records import JOINT_NAMES

ALIKE = 0.2  # of the logarithm of two bones' lengths: the limbs of captured people are not quite the same
SHIN, UPPER_ARM, FOREARM = 0.97, 0.66, 0.6  # of a thigh
DEEP = 24  # joints of a limb that are looked at: an arm with a finger has some nine
SIBLINGS, PAIRS = 8, 20  # limbs from one joint, and pairs of all, that are looked at, the longest
CROOKED, BENT = 4.0, 0.5  # what a bone that is not straight, and a joint that bends, weigh
BENDS = 0.1  # rad: who moves less says nothing
POSES = 200  # frames that are looked at
LEG, ARM = ("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")


class Found(NamedTuple):
    """SMPL joint -> joint for arms and legs; the head, if any; and what told left from right, in words."""

    limbs: dict[int, int]
    head: int | None
    sides: str


def by_tree(bvh: Bvh, side_of: Callable[[str], str]) -> Found | None:
    """The body in a skeleton; None where there are not two pairs of limbs. `side_of`: a name -> "left", "right" or ""."""
    limbs, at = _limbs(bvh), _in_the_world(bvh)
    parents = bvh.parents.tolist()
    chosen = next((two for two in combinations(_pairs(bvh, limbs)[:PAIRS], 2) if not _nested(parents, *two)), None)
    if chosen is None:
        return None
    longer, other = chosen
    above = parents[other[0]] in ancestors(parents, parents[longer[0]])[:-1]
    legs, arms = (other, longer) if above else (longer, other)
    leg = _three(bvh, at, limbs[legs[0]], lambda a, b, whole: 1.2 * abs(np.log(b / a / SHIN)) - (a + b) / whole)
    thigh = np.diff(_along(bvh, limbs[legs[0]])[list(leg or (0, 0))])[0]
    arm = leg and _three(
        bvh, at, limbs[arms[0]], lambda a, b, _: abs(np.log(a / thigh / UPPER_ARM)) + abs(np.log(b / thigh / FOREARM))
    )
    if leg is None or arm is None:
        return None
    return _sided(bvh, at[0], limbs, {"leg": (legs, leg), "arm": (arms, arm)}, side_of)


def ancestors(parents: list[int], joint: int) -> list[int]:
    """The joints from the root down to `joint`, both included."""
    line = [joint]
    while parents[line[-1]] >= 0:
        line.append(parents[line[-1]])
    return line[::-1]


def _limbs(bvh: Bvh) -> list[list[int]]:
    """For each joint the longest way down from it, at most DEEP joints of it."""
    count = len(bvh.names)
    steps = np.linalg.norm(bvh.places[0], axis=1)
    reach, onward = np.zeros(count), np.full(count, -1)
    for joint in range(count - 1, 0, -1):
        parent = bvh.parents[joint]
        if onward[parent] < 0 or steps[joint] + reach[joint] > reach[parent]:
            reach[parent], onward[parent] = steps[joint] + reach[joint], joint
    found = []
    for joint in range(count):
        line = [joint]
        while onward[line[-1]] >= 0 and len(line) < DEEP:
            line.append(int(onward[line[-1]]))
        found.append(line)
    return found


def _along(bvh: Bvh, limb: list[int]) -> np.ndarray:
    """How far along a limb its joints are, in the file's unit."""
    return np.concatenate([[0.0], np.linalg.norm(bvh.places[0, limb[1:]], axis=1).cumsum()])


def _pairs(bvh: Bvh, limbs: list[list[int]]) -> list[tuple[int, int]]:
    """Joints at which two like limbs begin, the longest pair first."""
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(bvh.parents.tolist()):
        if len(limbs[joint]) >= len(LEG):
            children.setdefault(parent, []).append(joint)
    whole = {joint: _along(bvh, limbs[joint]) for own in children.values() for joint in own}
    found = []
    for own in children.values():
        longest = sorted(own, key=lambda joint: -whole[joint][-1])[:SIBLINGS]
        for a, b in combinations(longest, 2):
            one, two = (np.diff(whole[joint]) + 0.02 * whole[a][-1] for joint in (a, b))
            if len(one) == len(two) and whole[a][-1] > 0 and (abs(np.log(one / two)) < ALIKE).all():
                found.append((a, b))
    return sorted(found, key=lambda pair: -whole[pair[0]][-1])


def _nested(parents: list[int], one: tuple[int, int], two: tuple[int, int]) -> bool:
    """Whether a pair hangs on a limb of the other."""
    return bool({*one} & {*ancestors(parents, two[0])} or {*two} & {*ancestors(parents, one[0])})


def _three(
    bvh: Bvh, at: np.ndarray, limb: list[int], cost: Callable[[float, float, float], float]
) -> tuple[int, int, int] | None:
    """The places along a limb of the three joints between which two bones cost least; ends of bones only where joints lack.

    The bones of a limb stay straight, and the middle joint is one that bends.
    """
    along, at = _along(bvh, limb), at[:, limb]
    bends = _bends(at)

    def costs(way: tuple[int, int, int]) -> float:
        i, j, k = way
        long = along[j] - along[i], along[k] - along[j]
        short = (np.linalg.norm(at[:, end] - at[:, begin], axis=1).mean() for begin, end in ((i, j), (j, k)))
        crooked = sum(1 - chord / bone for chord, bone in zip(short, long))
        return cost(*long, along[-1]) + CROOKED * crooked - BENT * bends[j]

    joints = [i for i, joint in enumerate(limb) if bvh.names[joint]]
    for among in (joints, range(len(limb))):
        ways = [(i, j, k) for i, j, k in combinations(among, 3) if along[i] < along[j] < along[k]]
        if ways:
            return min(ways, key=costs)
    return None


def _in_the_world(bvh: Bvh) -> np.ndarray:
    """Where all joints are [F,J,3], in POSES frames at most."""
    shown = slice(None, None, len(bvh) // POSES + 1)
    turns, at = bvh.rotations[shown].copy(), bvh.places[shown].copy()
    for joint, parent in enumerate(bvh.parents.tolist()):
        if parent >= 0:
            at[:, joint] = at[:, parent] + (turns[:, parent] @ at[:, joint, :, None])[..., 0]
            turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return at


def _bends(at: np.ndarray) -> np.ndarray:
    """How much each joint of a limb bends in the motion, of the one that does most; 0 where none moves."""
    bones = np.diff(at, axis=1)
    bones = bones / np.maximum(np.linalg.norm(bones, axis=2, keepdims=True), 1e-12)
    found = np.zeros(at.shape[1])
    found[1:-1] = np.ptp(np.arccos(np.clip((bones[:, 1:] * bones[:, :-1]).sum(2), -1, 1)), axis=0)
    return found / found.max() if found.max(initial=0) > BENDS else np.zeros(len(found))


def _sided(
    bvh: Bvh,
    at: np.ndarray,
    limbs: list[list[int]],
    found: Mapping[str, tuple[tuple[int, int], tuple[int, int, int]]],
    side_of: Callable[[str], str],
) -> Found:
    """The pairs with their sides: by names, else by where the feet point, else as if the body looked along z.

    `at` [J,3]: the joints in the first frame.
    """
    (legs, leg), (arms, arm) = found["leg"], found["arm"]
    hips, shoulders = (at[[limbs[joint][three[0]] for joint in pair]] for pair, three in ((legs, leg), (arms, arm)))
    toes = [(limbs[joint][leg[2]], limbs[joint][leg[2] + 1 :]) for joint in legs]
    ahead = sum((at[line[0]] - at[ankle] for ankle, line in toes if line and bvh.names[line[0]]), np.zeros(3))
    left, told = np.cross(shoulders.mean(0) - hips.mean(0), ahead), "their feet, which point ahead"
    if not np.linalg.norm(left) > 1e-6 * np.linalg.norm(shoulders - hips) ** 2:
        left, told = np.array([1.0, 0, 0]), "x, as if they looked along z"
    result: dict[int, int] = {}
    for pair, three, ends in ((legs, leg, hips), (arms, arm, shoulders)):
        voted = [{side_of(bvh.names[joint]) for joint in limbs[start]} - {""} for start in pair]
        if voted in ([{"left"}, {"right"}], [{"right"}, {"left"}]):
            order, told = (pair if voted[0] == {"left"} else pair[::-1]), "their names"
            left = (ends[0] - ends[1]) * (1 if order == pair else -1)
        else:
            order = pair if (ends[0] - ends[1]) @ left > 0 else pair[::-1]
        names, beside = (LEG, ("foot", three[2] + 1)) if pair == legs else (ARM, ("collar", three[0] - 1))
        for side, start in zip(("left", "right"), order):
            limb = limbs[start]
            more = [beside] if 0 <= beside[1] < len(limb) and bvh.names[limb[beside[1]]] else []
            for part, place in (*zip(names, three), *more):
                result[JOINT_NAMES.index(f"{side}_{part}")] = limb[place]
    others = [j for j, parent in enumerate(bvh.parents.tolist()) if parent == bvh.parents[arms[0]] and j not in arms]
    crown = max((limbs[j] for j in others), key=lambda limb: _along(bvh, limb)[-1], default=[])
    named = [joint for joint in crown[:2] if bvh.names[joint]]
    return Found(result, named[-1] if named else None, told)

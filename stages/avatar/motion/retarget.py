"""Motions of other skeletons on SMPL's: limbs point where they pointed, the rest turns as it turned. float64, no files.

The rest poses of two skeletons differ (T or A, joints turned into their bones). So both are brought into one reference
pose, and from there SMPL's joints turn with theirs: R = G G_ref^T R_ref, with G the source's turns in the world. Twist
is thereby the source's own. The reference is the zero pose, where nothing is turned, if a person could stand like that.
Else the skeleton's joint axes follow its bones: limbs then refer to the frame most like standing, and each joint of
the trunk is turned by the right angles that fit the trunk's mean best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stages.avatar.body.joints import (
    ANKLES,
    COLLARS,
    ELBOWS,
    FEET,
    HANDS,
    HEAD,
    HIPS,
    KNEES,
    NECK,
    SHOULDERS,
    SPINE,
    WRISTS,
)
from stages.avatar.body.smpl_rest import PARENTS, smpl_rest
from stages.avatar.motion.between import between
from stages.avatar.motion.hands import from_bones
from stages.gestures import Fingers
from stages.records import JOINT_NAMES

LIMBS = {
    bone: end
    for chain in ((HIPS, KNEES, ANKLES), (SHOULDERS, ELBOWS, WRISTS))
    for row in zip(*chain)
    for bone, end in zip(row, row[1:])
}
"""Joint at which a limb's bone begins -> joint at its end: these bones keep their direction in the world."""
STANDING = 0.7
"""The zero pose is a stand where leg bones have over this mean cosine with the trunk's down."""
ROUNDED = 0.05
"""Of a step: where the last frame comes that much too early for another one, its time was rounded, and the frame is kept."""
SMPL_LEG = 0.79
"""Hip to knee to ankle of SMPL's mean body, m: the scale of a motion whose body is not known."""


_PAIRS = (COLLARS, HIPS, SHOULDERS, KNEES, ELBOWS, ANKLES, WRISTS, FEET, HANDS)


class Skeleton(NamedTuple):
    """A moving skeleton: parents [J] (before their children, -1 the root's), places [F,J,3] in the parent's axes and
    rotations [F,J,3,3] from a joint's axes to its parent's, in any unit of length; names [J] for messages.
    """

    names: Sequence[str]
    parents: np.ndarray
    places: np.ndarray
    rotations: np.ndarray


class Performance(NamedTuple):
    """What SMPL's joints do: local rotations [F,24,3,3], root first, and the middle of the hips [F,3].

    Both in the source's axes; `leg` is the source's length of hip to knee to ankle, in the unit of `hips`. `hands`
    [F,2,15,3,3], as in `hands`, and coefficients `face` [F,K], where the source has them.
    """

    rotations: np.ndarray
    hips: np.ndarray
    leg: float
    hands: np.ndarray | None = None
    face: np.ndarray | None = None


def from_skeleton(
    skeleton: Skeleton,
    limbs: Mapping[int, int],
    pelvis: int,
    spine: Sequence[int],
    neck: Sequence[int],
    joints: np.ndarray,
    parents: Sequence[int],
    fingers: tuple[Fingers, Mapping[int, tuple[int, int]]] | None = None,
) -> Performance:
    """The performance of another skeleton by a body with rest `joints` [24,3] m (y up, facing z) and `parents` [24].

    `limbs` maps SMPL joints to the skeleton's; `pelvis`, `spine`, `neck` are its joints from the hips to the head, any
    number of them, whose bend is spread over SMPL's. Arms and legs must be mapped down to wrists and ankles; collars
    and toes may be missing and then follow what carries them. The directions of LIMBS come out exact. `fingers` are those of the
    body, and which joints theirs go between, see `from_bones`. Raises ValueError for bones without length.
    """
    turns, places = _in_the_world(skeleton)
    at = {joint: places[:, limbs[joint]] for joint in limbs}
    for a, b in (*LIMBS.items(), HIPS):
        short = (np.linalg.norm(at[b] - at[a], axis=-1) < 1e-6 * np.ptp(places, axis=1).max())[1:]
        if short.any():
            ends = f"{skeleton.names[limbs[a]]} and {skeleton.names[limbs[b]]}"
            raise ValueError(f"{ends} stand in one place in {short.sum()} of {len(short)} frames")
    bodies, reference = _trunk(at), _reference(at)

    def trunk(joint: int) -> np.ndarray:
        own = bodies[0] if reference == 0 else _squared((turns[1:, joint].mT @ bodies[1:]).mean(0))
        return turns[:, joint] @ own @ _trunk(dict(enumerate(joints))).T

    world = np.zeros((len(turns), 24, 3, 3))
    world[:, 0] = trunk(pelvis)
    spines = [world[:, 0], *map(trunk, spine)]
    world[:, SPINE] = _spread(spines, len(SPINE))
    world[:, [NECK, HEAD]] = _spread([spines[-1], *map(trunk, neck)], 2)
    start = _start({joint: place[reference] for joint, place in at.items()}, world[reference], joints, parents)

    def follow(joint: int, source: int) -> np.ndarray:
        return turns[:, source] @ turns[reference, source].T @ start[joint]

    for joint in (joint for pair in _PAIRS for joint in pair):
        mapped = joint in limbs and joint not in FEET
        world[:, joint] = follow(joint, limbs[joint]) if mapped else world[:, parents[joint]]
        if joint in LIMBS:  # twist bones inside a limb let it bend: aim at where its end is
            bone = joints[LIMBS[joint]] - joints[joint]
            world[:, joint] = turn_between(world[:, joint] @ bone, at[LIMBS[joint]] - at[joint]) @ world[:, joint]
    above = world[:, [max(parent, 0) for parent in parents]]
    local = above.mT @ world
    local[:, 0] = world[:, 0]
    hips = (at[HIPS[0]] + at[HIPS[1]]) / 2
    leg, bent = float(_leg({joint: place[reference] for joint, place in at.items()})), None
    if fingers is not None:
        own, chains = fingers
        bent = from_bones(turns, places, reference, chains, world[:, HANDS], own)
    return Performance(local[1:], hips[1:], leg, bent)


def from_smpl(rotvecs: np.ndarray, transl: np.ndarray, joints: np.ndarray) -> Performance:
    """The performance of an SMPL motion, rotvecs [F,24,3] rad and transl [F,3] m, of a body that is not known.

    The middle of the hips is placed as in SMPL's mean body, whose legs are SMPL_LEG long; `joints` [24,3] m at rest are
    those of the body that will move, and lend it their proportions.
    """
    rotations = Rotation.from_rotvec(rotvecs.reshape(-1, 3)).as_matrix().reshape(*rotvecs.shape[:2], 3, 3)
    below = (joints[HIPS[0]] + joints[HIPS[1]]) / 2 - joints[0]
    return Performance(rotations, transl + rotations[:, 0] @ below * (SMPL_LEG / leg_of(joints)), SMPL_LEG)


def carried_over(rotvecs: np.ndarray, transl: np.ndarray, joints: np.ndarray, parents: Sequence[int]) -> Performance:
    """As `from_smpl`, for a body that rests otherwise than SMPL: SMPL's skeleton is then one like any other.

    Its limbs point where those of SMPL's mean body point.
    """
    rest = smpl_rest()
    places = np.tile(rest - rest[np.maximum(PARENTS, 0)], (len(transl), 1, 1))
    places[:, 0] = rest[0] + transl
    rotations = Rotation.from_rotvec(rotvecs.reshape(-1, 3)).as_matrix().reshape(*rotvecs.shape[:2], 3, 3)
    skeleton = Skeleton(JOINT_NAMES, np.array(PARENTS), places, rotations)
    limbs = {joint: joint for pair in _PAIRS for joint in pair}
    return from_skeleton(skeleton, limbs, 0, SPINE, (NECK, HEAD), joints, parents)


def leg_of(joints: np.ndarray) -> float:
    """Hip to knee to ankle of rest `joints` [24,3], mean of both sides, in their unit."""
    return float(_leg(dict(enumerate(joints))))


def resample(motion: Performance, fps: float, wanted: float) -> Performance:
    """The performance at `wanted` frames a second instead of `fps`, turning evenly between frames; same length in time."""
    return resample_at(motion, np.arange(len(motion.hips)) / fps, wanted)


def resample_at(motion: Performance, times: np.ndarray, wanted: float) -> Performance:
    """As `resample`, of frames at any rising `times` [F] s."""
    if len(times) == 1:
        return motion
    times = times - times[0]
    new = np.arange(np.floor(times[-1] * wanted + ROUNDED) + 1) / wanted
    new = new.clip(max=times[-1])

    def turned(rotations: np.ndarray) -> np.ndarray:
        rows = [Slerp(times, Rotation.from_matrix(one))(new).as_matrix() for one in np.moveaxis(rotations, 1, 0)]
        return np.stack(rows, 1)

    hips, face = between(new, times, motion.hips), None if motion.face is None else between(new, times, motion.face)
    hands = None if motion.hands is None else turned(motion.hands.reshape(-1, 30, 3, 3)).reshape(-1, 2, 15, 3, 3)
    return Performance(turned(motion.rotations), hips, motion.leg, hands, face)


def turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Smallest rotations [...,3,3] that take the directions `a` [...,3] to `b` [...,3], of any length above 0.

    Opposite directions are joined by a half turn about some axis across.
    """
    a, b = np.broadcast_arrays(_unit(a), _unit(b))
    length = np.linalg.norm(a + b, axis=-1, keepdims=True)
    opposite = length < 1e-9
    across = np.cross(a, np.eye(3)[np.abs(a).argmin(-1)])
    middle = np.where(opposite, _unit(across), (a + b) / np.where(opposite, 1, length))
    return _half_turn(middle) @ _half_turn(a)


def _half_turn(axis: np.ndarray) -> np.ndarray:
    return 2 * axis[..., :, None] * axis[..., None, :] - np.eye(3)


def _in_the_world(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Turns [1+F,J,3,3] and places [1+F,J,3] of all joints in the world; the first is the zero pose."""
    still = np.broadcast_to(np.eye(3), (1, *skeleton.rotations.shape[1:]))
    local = np.concatenate([still, skeleton.rotations])
    steps = np.concatenate([skeleton.places[:1], skeleton.places])
    turns, places = local.copy(), steps.copy()
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            turns[:, joint] = turns[:, parent] @ local[:, joint]
            places[:, joint] = places[:, parent] + (turns[:, parent] @ steps[:, joint, :, None])[..., 0]
    return turns, places


def _reference(at: Mapping[int, np.ndarray]) -> int:
    """Which frame both skeletons are compared in: 0, the zero pose, if it is a stand, else the most upright one."""
    up = _trunk(at)[..., 1]
    bones = {joint: _unit(at[end] - at[joint]) for joint, end in LIMBS.items()}
    legs = sum(-(bones[joint] * up).sum(-1) for joint in HIPS + KNEES) / 4
    arms = sum((bones[a] * bones[b]).sum(-1) for a, b in zip(SHOULDERS, ELBOWS)) / 2
    return 0 if legs[0] > STANDING else 1 + int((legs + 0.5 * arms)[1:].argmax())


def _start(
    at: Mapping[int, np.ndarray], world: np.ndarray, joints: np.ndarray, parents: Sequence[int]
) -> dict[int, np.ndarray]:
    """How SMPL's joints [3,3] are turned in the reference pose: the trunk by `world` [24,3,3], limbs without any twist."""
    start = {joint: world[joint] for joint in (0, *SPINE, NECK, HEAD)}
    for joint in range(1, 24):
        above = start[parents[joint]]
        if joint in LIMBS:
            bone = joints[LIMBS[joint]] - joints[joint]
            start[joint] = turn_between(above @ bone, at[LIMBS[joint]] - at[joint]) @ above
        elif joint in ANKLES and (toe := FEET[ANKLES.index(joint)]) in at:
            # skeletons draw the toes at any height: only their heading is taken, the sole stays across the shin
            seen, own = above.T @ (at[toe] - at[joint]), joints[toe] - joints[joint]
            start[joint] = above @ turn_between(own * [1, 0, 1], seen * [1, 0, 1])
        elif joint not in start:
            start[joint] = above
    return start


def _squared(turn: np.ndarray) -> np.ndarray:
    """The nearest rotation [3,3] by right angles."""
    cube = Rotation.create_group("O").as_matrix()
    return cube[(cube * turn).sum((1, 2)).argmax()]


def _trunk(at: Mapping[int, np.ndarray]) -> np.ndarray:
    """Axes [...,3,3] of the trunk as columns: left along the hips, up from them to the shoulders, ahead."""
    hips, shoulders = ((at[pair[0]] + at[pair[1]]) / 2 for pair in (HIPS, SHOULDERS))
    left = _unit(at[HIPS[0]] - at[HIPS[1]])
    up = shoulders - hips
    up = _unit(up - (up * left).sum(-1, keepdims=True) * left)
    return np.stack([left, up, np.cross(left, up)], -1)


def _leg(at: Mapping[int, np.ndarray]) -> float:
    bones = [at[LIMBS[joint]] - at[joint] for joint in HIPS + KNEES]
    return np.linalg.norm(bones, axis=-1).sum() / 2


def _spread(turns: list[np.ndarray], count: int) -> np.ndarray:
    """The bend of a chain of turns [F,3,3], its base first, over `count` joints: [F,count,3,3], the last as its last."""
    spread = []
    for k in range(1, count + 1):
        below, share = divmod(k * (len(turns) - 1) / count, 1)
        low = turns[int(below)]
        high = turns[min(int(below) + 1, len(turns) - 1)]
        bend = Rotation.from_matrix(low.mT @ high).as_rotvec() * share
        spread.append(low @ Rotation.from_rotvec(bend).as_matrix())
    return np.stack(spread, 1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)

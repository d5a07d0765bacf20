"""A motion as BVH, the text that nearly every program with a skeleton reads: metres, y up, facing z, the floor at height 0.

With all angles 0 it is the T-pose, with fingers as they lie in the avatar; a take that does not move them has none. The place of
the root moves, and the angles of all joints.
https://research.cs.wisc.edu/graphics/Courses/cs-838-1999/Jeff/BVH.html
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stages.formats.exchange.bone_names import Names
from stages.formats.exchange.skeleton import skeleton_of
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES, JOINTS, Rig, Take

LEGS = ("hip", "knee", "ankle", "foot")
ORDERS = ("ZXY", "ZYX")
"""Of the angles, the one that turns last first; legs have the second order. Angles jump where the middle one is near 90
degrees: legs bend about x, elbows about y and hanging arms about z, and hardly ever so far about the middle one here."""
ENDS = {
    "head": (0.0, 0.2, 0.0),
    "foot": (0.0, 0.0, 0.08),
    "left_hand": (0.08, 0.0, 0.0),
    "right_hand": (-0.08, 0.0, 0.0),
}
"""Where bones without a child end, m."""


class _Bones(NamedTuple):
    """What the file has of J joints: names, places [J,3] m at rest, where bones without a child end, and who hangs on whom."""

    names: Sequence[str]
    places: np.ndarray
    ends: dict[int, tuple[float, ...]]
    children: dict[int, list[int]]


def write_motion_bvh(path: Path, rig: Rig, take: Take, names: Names = "smpl", floor: float = 0.0) -> None:
    """Write a take with even times, of a rig without its clothes.

    The take's floor is at the height `floor` m of the rig's joints. A single pose lasts a second. The same take makes the same
    bytes.
    """
    bones = _bones(rig, names, take.fingers is not None)
    turns = take.rotations if take.fingers is None else np.concatenate([take.rotations, take.fingers], 1)
    (root,) = bones.children[-1]
    order = list(_downwards(root, bones.children))
    lines = ["HIERARCHY", *_hierarchy(root, bones)]
    seconds = take.times[-1] / (len(take) - 1) if len(take) > 1 else 1.0
    lines += ["MOTION", f"Frames: {len(take)}", f"Frame Time: {seconds:.8f}"]
    rows = np.concatenate([take.pelvis - [0, floor, 0], _angles(turns)[:, order].reshape(len(take), -1)], 1)
    lines += [" ".join(f"{value:.5f}" for value in row + 0.0) for row in np.round(rows, 5)]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _bones(rig: Rig, names: Names, fingers: bool) -> _Bones:
    skeleton = skeleton_of(replace(rig, clothes=None, finger_joints=rig.finger_joints if fingers else None), names)
    ends: dict[int, tuple[float, ...]] = {
        i: end for i, name in enumerate(JOINT_NAMES) if (end := ENDS.get(name) or ENDS.get(name.partition("_")[2]))
    }
    if rig.finger_joints is not None:
        joints, tips = np.split(rig.finger_joints, [len(FINGER_NAMES)])
        ends |= {JOINTS + 3 * finger + 2: tuple(end) for finger, end in enumerate((tips - joints[2::3]).tolist())}
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(skeleton.parents.tolist()):
        children.setdefault(parent, []).append(joint)
    return _Bones(skeleton.names, skeleton.places, ends, children)


def _downwards(joint: int, children: dict[int, list[int]]) -> Iterator[int]:
    """The joints from `joint` on, in the order in which the file names them."""
    yield joint
    for child in children.get(joint, ()):
        yield from _downwards(child, children)


def _hierarchy(joint: int, bones: _Bones, above: int = -1) -> Iterator[str]:
    """The lines of a joint and all below it. The root's offset is 0: some programs add it to its place, some do not."""
    step = bones.places[joint] - bones.places[above] if above >= 0 else np.zeros(3)
    place = "" if above >= 0 else "Xposition Yposition Zposition "
    yield f"{'ROOT' if above < 0 else 'JOINT'} {bones.names[joint]}"
    yield "{"
    yield _offset(step)
    turns = " ".join(f"{axis}rotation" for axis in _order(joint))
    yield f"CHANNELS {3 + 3 * (above < 0)} {place}{turns}"
    for child in bones.children.get(joint, ()):
        yield from _hierarchy(child, bones, joint)
    if joint not in bones.children:
        yield from ("End Site", "{", _offset(bones.ends[joint]), "}")
    yield "}"


def _offset(step: Sequence[float] | np.ndarray) -> str:
    return "OFFSET " + " ".join(f"{value:.6f}" for value in step)


def _order(joint: int) -> str:
    return ORDERS[joint < JOINTS and JOINT_NAMES[joint].partition("_")[2] in LEGS]


def _angles(rotations: np.ndarray) -> np.ndarray:
    """Quaternions [F,J,4] w x y z as angles [F,J,3] in degrees, in each joint's order, those of a joint near those before.

    Of two triples that are the same rotation the nearer one is taken, and whole turns are added.
    """
    turns = [Rotation.from_quat(rotations[:, joint], scalar_first=True) for joint in range(rotations.shape[1])]
    found = np.stack([turn.as_euler(_order(joint), degrees=True) for joint, turn in enumerate(turns)], 1)
    for before, now in zip(found, found[1:]):
        both = np.stack([now, now * [1, -1, 1] + 180])
        both -= 360 * np.round((both - before) / 360)
        nearer = np.abs(both - before).sum(-1).argmin(0)
        now[:] = np.take_along_axis(both, nearer[None, :, None], 0)[0]
    return found

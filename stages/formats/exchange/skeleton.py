"""The skeleton in glTF: a node a joint, whose y axis runs along its bone, as programs that pose by hand expect it.

Bones of clothes are joints like others, named cloth_00 on, each below the joint that carries most of it; fingers come last.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stages.formats.exchange.bone_names import Names, bone_names, finger_names
from stages.formats.exchange.glb import Arrays
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES, JOINTS, Rig, Take

GOES_ON = {"pelvis": "spine1", "spine3": "neck"}
"""Where a bone ends of whose joint several begin."""
AHEAD, UP = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])
FLAT = 0.7  # cosine to AHEAD above which a bone lies along it
HANDS = [JOINT_NAMES.index(f"{side}_hand") for side in ("left", "right")]


class Skeleton(NamedTuple):
    """J joints at rest: `names`, `parents` [J], `places` [J,3] m and `turns` [J,3,3], their axes in the world's as columns."""

    names: tuple[str, ...]
    parents: np.ndarray
    places: np.ndarray
    turns: np.ndarray

    def nodes(self, first: int) -> list[dict[str, Any]]:
        """A node a joint; the first will be node `first` of the file."""
        made: list[dict[str, Any]] = []
        for joint, (name, parent) in enumerate(zip(self.names, self.parents.tolist(), strict=True)):
            above = self.turns[parent] if parent >= 0 else np.eye(3)
            step = above.T @ (self.places[joint] - (self.places[parent] if parent >= 0 else 0))
            quat = Rotation.from_matrix(above.T @ self.turns[joint]).as_quat(canonical=True)
            made.append({"name": name, "translation": step.tolist(), "rotation": quat.tolist()})
            children = [first + int(child) for child in np.flatnonzero(self.parents == joint)]
            made[-1] |= {"children": children} if children else {}
        return made

    def inverse_binds(self) -> np.ndarray:
        """Rows [J,16] float32 of the matrices from the T-pose into each joint's axes, column by column."""
        matrices = np.tile(np.eye(4), (len(self.names), 1, 1))
        matrices[:, :3, :3] = self.turns.mT
        matrices[:, :3, 3] = -(self.turns.mT @ self.places[..., None])[..., 0]
        return np.ascontiguousarray(matrices.mT.reshape(-1, 16), np.float32)

    def animation(self, take: Take, arrays: Arrays, first: int) -> dict[str, Any]:
        """Samplers and channels of a motion for the joints from node `first`."""
        times = arrays.add(take.times.astype(np.float32), bounds=True)
        samplers: list[dict[str, int]] = []
        channels: list[dict[str, Any]] = []

        def move(joint: int, path: str, values: np.ndarray) -> None:
            channels.append({"sampler": len(samplers), "target": {"node": first + joint, "path": path}})
            samplers.append({"input": times, "output": arrays.add(np.ascontiguousarray(values, np.float32))})

        def turn(joint: int, quats: np.ndarray) -> None:
            parent = self.parents[joint]
            above = Rotation.from_matrix(self.turns[parent] if parent >= 0 else np.eye(3))
            turned = (
                above.inv() * Rotation.from_quat(quats, scalar_first=True) * Rotation.from_matrix(self.turns[joint])
            )
            move(joint, "rotation", _near(turned.as_quat()))

        move(0, "translation", take.pelvis)
        for joint in range(JOINTS):
            turn(joint, take.rotations[:, joint])
        for bone in range(0 if take.fingers is None else len(FINGER_NAMES)):
            turn(len(self.names) - len(FINGER_NAMES) + bone, np.asarray(take.fingers)[:, bone])
        for k in range(0 if take.clothes is None else take.clothes.shape[1]):
            moved, joint = np.asarray(take.clothes)[:, k], JOINTS + k
            turn(joint, moved[:, :4])
            move(joint, "translation", moved[:, 4:] @ self.turns[self.parents[joint]])
        return {"samplers": samplers, "channels": channels}


def skeleton_of(rig: Rig, names: Names = "smpl") -> Skeleton:
    """The joints of a rig, the bones of its clothes and, if it has some, its finger bones."""
    fingers = rig.finger_joints is not None
    places, parents, called = rig.joints.astype(float), np.asarray(rig.parents), bone_names(names, fingers)
    if rig.clothes is not None:
        places = np.concatenate([places, rig.clothes.centres])
        parents = np.concatenate([parents, rig.clothes.hang_on])
        called = (*called, *(f"cloth_{k:02d}" for k in range(len(rig.clothes))))
    bare = Skeleton(called, parents, places, np.stack([_axes(along) for along in _along(places, parents)]))
    return bare if rig.finger_joints is None else _fingered(bare, rig.finger_joints, finger_names(names))


def _fingered(bare: Skeleton, finger_joints: np.ndarray, names: tuple[str, ...]) -> Skeleton:
    """A skeleton with finger bones of those `names`, from joints and tips [40,3] m."""
    joints, tips = np.split(finger_joints, [len(FINGER_NAMES)])
    chains = np.concatenate([joints.reshape(10, 3, 3), tips[:, None]], 1)
    ways = np.diff(chains, axis=1).reshape(-1, 3)
    first = len(bare.names)
    parents = [HANDS[bone // 15] if bone % 3 == 0 else first + bone - 1 for bone in range(len(FINGER_NAMES))]
    return Skeleton(
        (*bare.names, *names),
        np.concatenate([bare.parents, parents]),
        np.concatenate([bare.places, joints]),
        np.concatenate([bare.turns, np.stack([_axes(way / np.linalg.norm(way)) for way in ways])]),
    )


def _along(places: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Unit directions [J,3] of bones: to the joint where the next begins, or as the one before goes on; those of clothes hang."""
    along = np.zeros_like(places)
    for joint, parent in enumerate(parents.tolist()):
        if joint >= JOINTS:
            along[joint] = -UP
            continue
        children = np.flatnonzero(parents[:JOINTS] == joint)
        if len(children) > 1 and (then := GOES_ON.get(JOINT_NAMES[joint])):
            children = np.array([JOINT_NAMES.index(then)])
        along[joint] = places[children].mean(0) - places[joint] if len(children) else places[joint] - places[parent]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    return np.where(length > 1e-6, along / np.maximum(length, 1e-6), UP)


def _axes(along: np.ndarray) -> np.ndarray:
    """Axes [3,3] as columns, of length 1: y along a bone, z as far ahead as may be, of a bone that lies so as far up."""
    z = UP if abs(along @ AHEAD) > FLAT else AHEAD
    z = z - (z @ along) * along
    z /= np.linalg.norm(z)
    return np.stack([np.cross(along, z), along, z], 1)


def _near(quats: np.ndarray) -> np.ndarray:
    """Quaternions [F,4] of which none is far from the one before: q and -q are one turn, and players interpolate."""
    flips = np.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0)
    quats[1:] *= np.cumprod(flips)[:, None]
    return quats

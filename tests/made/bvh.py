"""Writes BVH files of known SMPL motions, on skeletons whose rest pose, proportions and names are others than SMPL's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.made.skeleton import PARENTS

MIXAMO = (
    """Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase RightToeBase Neck
    LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand LeftFinger RightFinger"""
).split()
ARMS = {"left": (16, 18, 20, 22), "right": (17, 19, 21, 23)}
LEGS = {"left": (1, 4, 7, 10), "right": (2, 5, 8, 11)}


def world_of(local: np.ndarray) -> np.ndarray:
    """Rotations [F,24,3,3] in the world from those to the parent."""
    world = local.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def matrices(orient: np.ndarray, body_pose: np.ndarray) -> np.ndarray:
    """Local rotations [F,24,3,3] from rotation vectors [F,3] and [F,69]."""
    rotvecs = np.concatenate([orient, body_pose], 1).reshape(-1, 3)
    return Rotation.from_rotvec(rotvecs).as_matrix().reshape(len(orient), 24, 3, 3)


def a_pose() -> np.ndarray:
    """World rotations [24,3,3] of SMPL's joints as they stand in another rest pose: arms down 50, legs out 15 degrees."""
    rest = np.tile(np.eye(3), (24, 1, 1))
    for chains, angle in ((ARMS, -50), (LEGS, 15)):
        for side, sign in (("left", 1), ("right", -1)):
            rest[list(chains[side])] = Rotation.from_euler("z", sign * angle, degrees=True).as_matrix()
    return rest


def bones_along_x(joints: np.ndarray) -> np.ndarray:
    """World rotations [24,3,3] that lay every limb along +x, as skeletons do whose joints are turned into their bones."""
    rest = np.tile(np.eye(3), (24, 1, 1))
    for row in (*ARMS.values(), *LEGS.values()):
        for joint, end in zip(row, row[1:]):
            bone = joints[end] - joints[joint]
            twist = Rotation.from_rotvec([0.4 + joint, 0, 0])
            rest[joint] = (twist * Rotation.align_vectors([[1.0, 0, 0]], [bone])[0]).as_matrix()
        rest[row[-1]] = rest[row[-2]]
    return rest


def write_bvh(
    path: Path,
    joints: np.ndarray,
    local: np.ndarray,
    hips: np.ndarray,
    rest: np.ndarray,
    *,
    names: list[str] = MIXAMO,
    order: str = "ZXY",
    unit: float = 100.0,
    fps: float = 50.0,
    to_file: np.ndarray | None = None,
) -> Path:
    """A BVH in which a skeleton with rest `joints` [24,3] m does what SMPL's joints do by `local` [F,24,3,3].

    `rest` [24,3,3]: where the zero pose of the file has SMPL's joints in the world; `hips` [F,3] m the root's path,
    `unit` file units a metre, `to_file` [3,3] the rotation from y up to the file's axes.
    """
    to_file = np.eye(3) if to_file is None else to_file
    world = to_file @ world_of(local) @ rest.mT @ to_file.T
    turns = world.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        turns[:, joint] = world[:, parent].mT @ world[:, joint]
    lines = ["HIERARCHY"]

    def tell(joint: int, indent: str) -> None:
        parent = PARENTS[joint]
        bone = np.zeros(3) if parent < 0 else to_file @ rest[parent] @ (joints[joint] - joints[parent]) * unit
        places = "" if parent >= 0 else "Xposition Yposition Zposition "
        channels = places + " ".join(f"{axis}rotation" for axis in order)
        lines.append(f"{indent}{'ROOT' if parent < 0 else 'JOINT'} {names[joint]}")
        lines.extend([f"{indent}{{", f"{indent}\tOFFSET {' '.join(f'{x:.6f}' for x in bone)}"])
        lines.append(f"{indent}\tCHANNELS {len(channels.split())} {channels}")
        children = [child for child, above in enumerate(PARENTS) if above == joint]
        for child in children:
            tell(child, indent + "\t")
        if not children:
            lines.append(f"{indent}\tEnd Site\n{indent}\t{{\n{indent}\t\tOFFSET 0 1 0\n{indent}\t}}")
        lines.append(f"{indent}}}")

    tell(0, "")
    lines.extend(["MOTION", f"Frames: {len(local)}", f"Frame Time: {1 / fps:.8f}"])
    angles = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_euler(order, degrees=True).reshape(-1, 24, 3)
    for frame, place in zip(angles, hips @ to_file.T * unit, strict=True):
        row = [*place, *frame[_preorder(0)].ravel()]
        lines.append(" ".join(f"{x:.6f}" for x in row))
    path.write_text("\n".join(lines) + "\n")
    return path


def _preorder(joint: int) -> list[int]:
    return [joint, *(x for child, above in enumerate(PARENTS) if above == joint for x in _preorder(child))]

"""Carries poses of SMPL over to a body that rests otherwise, so that its bones point where SMPL's bones point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl_rest import PARENTS, smpl_rest
from stages.avatar.motion.retarget import turn_between
from stages.formats.given_fits.record import SmplFit
from stages.records import BodyModel

STRENGTH = 0.01  # m that a beta of 1 counts as when bones are made as long as SMPL's


def onto_body(fit: SmplFit, model: BodyModel) -> SmplFit:
    """A fit of SMPL as one of `model`, which rests otherwise: joints in the same places as nearly as its bones allow.

    The tool's betas are left out, since they are other shapes there; instead limbs and trunk are as long as those of SMPL's
    mean shape. The new fit still turns about SMPL's pelvis, so that another camera sees the same pixel; `offset` leads to ours.
    """
    regressor = model.J_regressor.astype(np.float64)
    theirs, rest = smpl_rest(), regressor @ model.v_template
    betas = nearest_shape(rest, np.einsum("jv,vcb->jcb", regressor, model.shapedirs), theirs)
    ours = rest + np.einsum("jv,vcb,b->jc", regressor, model.shapedirs, betas)
    orient, pose, way = carry_over(fit.global_orient, fit.body_pose, theirs, ours)
    return replace(
        fit,
        betas=np.tile(betas, (len(fit), 1)),
        global_orient=orient,
        body_pose=pose,
        pelvis=theirs[0] if fit.pelvis is None else fit.pelvis,
        offset=Rotation.from_rotvec(orient).inv().apply(way),
        notes=(
            *fit.notes,
            f"the poses of {fit.tool} are SMPL's, carried over to the {model.name} without their shape; "
            "give SMPL's own file with --body-model to keep both",
        ),
    )


def posed_joints(rest: np.ndarray, orient: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints [N,24,3] of a skeleton, its pelvis where it rests, and each joint's turn in the world [N,24,3,3]."""
    turns = Rotation.from_rotvec(np.concatenate([orient, pose], 1).reshape(-1, 3)).as_matrix()
    world = turns.reshape(-1, 24, 3, 3)
    joints = np.tile(rest, (len(orient), 1, 1))
    for joint, parent in enumerate(PARENTS[1:], 1):
        joints[:, joint] = joints[:, parent] + world[:, parent] @ (rest[joint] - rest[parent])
        world[:, joint] = world[:, parent] @ world[:, joint]
    return joints, world


def carry_over(
    orient: np.ndarray, pose: np.ndarray, theirs: np.ndarray, ours: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """global_orient [N,3], body_pose [N,69] and the way [N,3] from their pelvis to ours, m, from those of SMPL.

    `theirs` and `ours` are the joints [24,3] at rest. The trunk is carried over as a whole, by hips, shoulders and the
    line from hips to neck (Kabsch 1976), its hips in the same place: what lies between, each body divides in its own way.
    Collars, arms, legs and neck then aim at where their next joint is in the tool's body; feet, hands and head turn as
    the tool's do, from rests that point the same way.
    """
    wanted, turns = posed_joints(theirs, orient, pose)
    lines = [_unit(_TRUNK @ rest) for rest in (ours, theirs)]
    trunk = Rotation.align_vectors(lines[1], lines[0])[0].as_matrix()
    world, joints = turns @ trunk, np.zeros_like(wanted)
    hips = 0.5 * (wanted[:, 1] + wanted[:, 2])
    joints[:, 0] = hips - world[:, 0] @ (0.5 * (ours[1] + ours[2]) - ours[0])
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            joints[:, joint] = joints[:, parent] + world[:, parent] @ (ours[joint] - ours[parent])
        if joint in _AIMS:
            end = _AIMS[joint]
            bone = world[:, joint] @ (ours[end] - ours[joint])
            aim = wanted[:, end] - joints[:, joint]
            world[:, joint] = turn_between(_unit(bone), _unit(aim)) @ world[:, joint]
    local = world.copy()
    for joint, parent in enumerate(PARENTS[1:], 1):
        local[:, joint] = world[:, parent].mT @ world[:, joint]
    vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 24, 3)
    return vectors[:, 0], vectors[:, 1:].reshape(-1, 69), joints[:, 0] - wanted[:, 0]


def nearest_shape(joints: np.ndarray, change: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Betas [B] of a body with `joints` [24,3] at rest and their `change` [24,3,B], whose limbs and trunk are as long as theirs."""
    return nearest_lengths(joints, change, SEGMENTS, np.linalg.norm(SEGMENTS @ theirs, axis=1))


def nearest_lengths(joints: np.ndarray, change: np.ndarray, segments: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Betas [B] of a body with `joints` [24,3] at rest and their `change` [24,3,B], its `segments` [S,24] `wanted` [S] m long.

    Least squares in metres, a beta of 1 counting as STRENGTH m; five steps of Gauss and Newton.
    """
    betas = np.zeros(change.shape[2])
    for _ in range(5):
        bones = segments @ (joints + change @ betas)
        length = np.linalg.norm(bones, axis=1)
        slope = np.einsum("jc,jk,kcb->jb", bones / length[:, None], segments, change)
        left = np.concatenate([wanted - length, -STRENGTH * betas])
        betas = betas + np.linalg.lstsq(np.concatenate([slope, STRENGTH * np.eye(len(betas))]), left, rcond=None)[0]
    return betas


def lines_between(*ends: tuple[tuple[int, ...], tuple[int, ...]]) -> np.ndarray:
    """Weights [L,24] of joints, each row from the middle of some joints to the middle of others."""
    found = np.zeros((len(ends), 24))
    for row, (start, end) in zip(found, ends, strict=True):
        row[list(end)] += 1 / len(end)
        row[list(start)] -= 1 / len(start)
    return found


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


_TRUNK = lines_between(((2,), (1,)), ((17,), (16,)), ((1, 2), (12,)))
_AIMS = {1: 4, 2: 5, 4: 7, 5: 8, 7: 10, 8: 11, 12: 15, 13: 16, 14: 17, 16: 18, 17: 19, 18: 20, 19: 21}
_LIMBS = tuple(((a,), (b,)) for a, b in ((1, 4), (2, 5), (4, 7), (5, 8), (16, 18), (17, 19), (18, 20), (19, 21)))
SEGMENTS = np.concatenate([_TRUNK[2:], lines_between(*_LIMBS)])
"""Trunk, thighs, shanks, upper arms and forearms, each left and right."""

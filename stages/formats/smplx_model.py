"""SMPL-H and SMPL-X models as SMPL's 24 joints, with their fingers beside.

| model  | joints | what follows SMPL's first 22         |
|--------|--------|--------------------------------------|
| SMPL-H | 52     | 15 of each hand                      |
| SMPL-X | 55     | jaw, both eyes, then 15 of each hand |

Where SMPL has a joint for the hand, the middle finger begins. Jaw and eyes turn with the head, and are shapes of the face, see
`face_turns`; after FACE_NAMES come the first ten expressions. Pose correctives of all joints but the body's are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, take
from stages.formats.face_turns import turned
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES, JOINTS

FIRST = {52: 22, 55: 25}
"""Joints of a model -> the first joint of its fingers."""
BODY, HEAD = JOINTS - 2, JOINT_NAMES.index("head")
WRISTS = JOINT_NAMES.index("left_wrist"), JOINT_NAMES.index("right_wrist")
MIDDLE = [FINGER_NAMES.index(f"{side}_middle1") for side in ("left", "right")]
EXPRESSIONS, TAKEN = {20: 10, 400: 300}, 10
"""Columns of SMPL-X's `shapedirs` -> where its expressions begin, and how many are taken."""
MOVED, HELD = 5e-4, 0.5  # m that a shape moves a point of the face, and the weight of that on the head, at least
TIP, OWN = 8, 0.5  # vertices of a fingertip, and their least weight on its last bone


def as_smpl(arrays: Mapping[str, Any], path: Path, hint: str) -> dict[str, Any]:
    """The arrays of an SMPL-H or SMPL-X model as those of SMPL, with the arrays of `gestures.HandsFace`, of SMPL-H without a face;
    StageError with key and shape, for fingers that hang elsewhere, or that move no skin.
    """

    def get(key: str, *shape: int | None) -> np.ndarray:
        return checked(take(arrays, key, path, hint), shape, key, path, hint)

    vertices = get("v_template", None, 3).astype(np.float64)
    count, joints = len(vertices), len(arrays["J_regressor"])
    first, last = FIRST[joints], FIRST[joints] + len(FINGER_NAMES)
    regressor, weights = get("J_regressor", joints, count), get("weights", count, joints)
    body, fingers = np.array(weights[:, :BODY], np.float64), weights[:, first:last]
    body[:, HEAD] += weights[:, BODY:first].sum(1)
    posedirs = np.zeros((count, 3, 9 * (JOINTS - 1)), np.float32)
    posedirs[..., : 9 * (BODY - 1)] = get("posedirs", count, 3, 9 * (joints - 1))[..., : 9 * (BODY - 1)]
    parents = get("kintree_table", 2, joints)[0].astype(np.int64)
    bones = range(len(FINGER_NAMES))
    hangs = [WRISTS[bone // 15] if bone % 3 == 0 else first + bone - 1 for bone in bones]
    wrong = np.flatnonzero(parents[first:last] != hangs)
    if len(wrong):
        facts = [f"joint {first + i} has parent {parents[first + i]}, not {hangs[i]}" for i in wrong[:3]]
        raise StageError(f"the fingers in {path} do not hang as those of SMPL-H and SMPL-X", hint, facts)
    points = regressor[first:last] @ vertices
    tips = np.stack([_tip(vertices, fingers, points, bone, path, hint) for bone in bones[2::3]])
    hands = fingers.reshape(count, 2, -1).sum(2, dtype=np.float64)
    face = {}
    if first > BODY:
        shapedirs, own = get("shapedirs", count, 3, None), slice(BODY, first)
        face = _face(vertices, body[:, HEAD], weights[:, own], regressor[own] @ vertices, shapedirs)
    return {
        **arrays,
        "J_regressor": np.concatenate([regressor[:BODY], regressor[first:last][MIDDLE]]),
        "weights": np.concatenate([body, hands], 1),
        "posedirs": posedirs,
        "kintree_table": np.stack([np.append(parents[:BODY], WRISTS), np.arange(JOINTS)]),
        "finger_regressor": np.concatenate([regressor[first:last], tips]),
        "finger_weights": fingers,
        **face,
    }


def _face(
    vertices: np.ndarray, head: np.ndarray, weights: np.ndarray, joints: np.ndarray, shapedirs: np.ndarray
) -> dict[str, np.ndarray]:
    """`face_points` and `face_shapes` of what the head, with weights [V], carries: jaw and eyes with weights [V,3] at joints [3,3],
    and the expressions in `shapedirs` [V,3,N].
    """
    count = int(shapedirs.shape[2])
    begin = EXPRESSIONS.get(count, count)
    rows = np.flatnonzero(head > HELD)
    expressions = np.moveaxis(shapedirs[rows, :, begin : begin + TAKEN], 2, 0)
    shapes = np.concatenate([turned(vertices[rows], joints, weights[rows]), expressions])
    moved = np.linalg.norm(shapes, axis=2).max(0) > MOVED
    return {"face_points": vertices[rows[moved]], "face_shapes": shapes[:, moved]}


def _tip(vertices: np.ndarray, fingers: np.ndarray, points: np.ndarray, bone: int, path: Path, hint: str) -> np.ndarray:
    """The regressor row [V] of a fingertip: the mean of the vertices of a finger's last bone that are farthest from its joint."""
    own = np.flatnonzero(fingers[:, bone] > OWN)
    if not len(own):
        facts = [f"no vertex has more than {OWN} on {FINGER_NAMES[bone]}; the largest is {fingers[:, bone].max():.4g}"]
        raise StageError(f"weights in {path} move no fingertip", hint, facts)
    far = own[np.linalg.norm(vertices[own] - points[bone], axis=1).argsort()[-TIP:]]
    row = np.zeros(len(vertices))
    row[far] = 1 / len(far)
    return row

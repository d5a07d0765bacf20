"""SMPL-H and SMPL-X models as SMPL's 24 joints, with their fingers beside.

| model  | joints | what follows SMPL's first 22         |
|--------|--------|--------------------------------------|
| SMPL-H | 52     | 15 of each hand                      |
| SMPL-X | 55     | jaw, both eyes, then 15 of each hand |

Where SMPL has a joint for the hand, the middle finger begins. Jaw and eyes turn with the head; expressions are left out, since
none is one of FACE_NAMES, and so are the pose correctives of all joints but the body's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, take
from stages.gestures import FINGER_NAMES
from stages.records import JOINT_NAMES, JOINTS

FIRST = {52: 22, 55: 25}
"""Joints of a model -> the first joint of its fingers."""
BODY, HEAD = JOINTS - 2, JOINT_NAMES.index("head")
WRISTS = JOINT_NAMES.index("left_wrist"), JOINT_NAMES.index("right_wrist")
MIDDLE = [FINGER_NAMES.index(f"{side}_middle1") for side in ("left", "right")]
TIP, OWN = 8, 0.5  # vertices of a fingertip, and their least weight on its last bone


def as_smpl(arrays: Mapping[str, Any], path: Path, hint: str) -> dict[str, Any]:
    """The arrays of an SMPL-H or SMPL-X model as those of SMPL, with `finger_regressor` [40,V] and `finger_weights` [V,30] of
    `gestures.HandsFace`; StageError with key and shape, for fingers that hang elsewhere, or that move no skin."""

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
    return {
        **arrays,
        "J_regressor": np.concatenate([regressor[:BODY], regressor[first:last][MIDDLE]]),
        "weights": np.concatenate([body, hands], 1),
        "posedirs": posedirs,
        "kintree_table": np.stack([np.append(parents[:BODY], WRISTS), np.arange(JOINTS)]),
        "finger_regressor": np.concatenate([regressor[first:last], tips]),
        "finger_weights": fingers,
    }


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

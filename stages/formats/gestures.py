"""The optional arrays `fingers_...` and `face_...` of avatar.npz; of a face only what moves is stored.

`face_count` is there where a face has more shapes than FACE_NAMES.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, take
from stages.gestures import FACE_NAMES, FINGER_NAMES, Face, Fingers
from stages.records import Avatar

MOST = 1000
"""Shapes of a face: with more, an array is none."""
LEAST = 2e-4
"""m: a shape that moves a Gaussian less is taken not to move it."""


def gesture_arrays(avatar: Avatar) -> dict[str, np.ndarray]:
    """The arrays of an avatar's fingers and face as the file names them; none where it has neither."""
    arrays: dict[str, np.ndarray] = {}
    if avatar.fingers is not None:
        arrays |= {f"fingers_{name}": np.asarray(value, np.float32) for name, value in vars(avatar.fingers).items()}
        arrays |= {"fingers_rows": np.asarray(avatar.fingers.rows, np.int32)}
        arrays |= {"fingers_shares": np.asarray(avatar.fingers.shares, np.float16)}
    if avatar.face is not None:
        moves = np.asarray(avatar.face.moves, np.float32).reshape(-1, 3)
        at = np.flatnonzero(np.linalg.norm(moves, axis=1) > LEAST)
        arrays |= {"face_rows": np.asarray(avatar.face.rows, np.int32)}
        arrays |= {"face_at": at.astype(np.int32), "face_moves": moves[at].astype(np.float16)}
        if len(avatar.face.moves) > len(FACE_NAMES):
            arrays |= {"face_count": np.array(len(avatar.face.moves))}
    return arrays


def gestures_of(arrays: Mapping[str, Any], count: int, name: str, hint: str) -> tuple[Fingers | None, Face | None]:
    """Fingers and face in the arrays of the file `name`, of an avatar of `count` Gaussians, None without them; StageError for
    missing arrays, wrong shapes and rows that are none.
    """

    def one(key: str, *shape: int | None) -> np.ndarray:
        return checked(take(arrays, key, name, hint), shape, key, name, hint)

    def rows(key: str, length: int | None, limit: int) -> np.ndarray:
        found = one(key, length)
        if found.dtype.kind not in "iu" or not ((found >= 0) & (found < limit)).all():
            facts = [
                f"{key} holds {found.dtype} from {found.min()} to {found.max()}, wanted are whole numbers below {limit}"
            ]
            raise StageError(f"{name} is damaged", hint, facts)
        return found

    fingers, face = None, None
    if "fingers_rows" in arrays:
        held = rows("fingers_rows", None, count)
        shares = one("fingers_shares", len(held), len(FINGER_NAMES)).astype(np.float32)
        joints, tips = one("fingers_joints", len(FINGER_NAMES), 3), one("fingers_tips", len(FINGER_NAMES) // 3, 3)
        fingers = Fingers(joints, tips, one("fingers_shape", 2, 15, 3), held, shares)
    if "face_rows" in arrays:
        held = rows("face_rows", None, count)
        shapes = len(FACE_NAMES)
        if "face_count" in arrays:
            shapes = check_shapes(int(one("face_count")), "face_count", name, hint)
        moves = np.zeros((shapes * len(held), 3), np.float16)
        at = rows("face_at", None, len(moves))
        moves[at] = one("face_moves", len(at), 3)
        face = Face(held, moves.reshape(shapes, len(held), 3))
    return fingers, face


def check_shapes(count: int, key: str, path: Path | str, hint: str) -> int:
    """The `count` of shapes of a face that the array `key` has; StageError where it has fewer than FACE_NAMES, or too many."""
    if not len(FACE_NAMES) <= count <= MOST:
        facts = [f"it is of {count} shapes of a face, wanted are {len(FACE_NAMES)} to {MOST}"]
        raise StageError(f"{key} in {path} has the wrong shape", hint, facts)
    return count

"""Turns of SMPL-X's jaw and eyes as shapes of FACE_NAMES; a jaw's roll has none, and an eye's.

At coefficient 1 a joint turns as far as the free body's shapes turn its own: of `jawOpen` the 83 points that move most, those of
the chin, turn by 22.1 degrees about where the jaw hangs, and of `jawLeft` they go 6.3 mm aside, 76 mm before it; the 40 points of
an eyeball turn by 14.0 in and out, 9.4 up, 10.6 down. Axes are SMPL's: x left, y up, z ahead.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stages.gestures import FACE_NAMES

JAW, LEFT_EYE, RIGHT_EYE = range(3)
SLACK = np.radians(1.0)  # beyond what a shape does so far, nobody sees what is held
TURNS = {
    "jawOpen": (JAW, 0, 22.0),
    "jawLeft": (JAW, 1, 5.0),
    "jawRight": (JAW, 1, -5.0),
    "eyeLookDownLeft": (LEFT_EYE, 0, 11.0),
    "eyeLookDownRight": (RIGHT_EYE, 0, 11.0),
    "eyeLookUpLeft": (LEFT_EYE, 0, -9.0),
    "eyeLookUpRight": (RIGHT_EYE, 0, -9.0),
    "eyeLookInLeft": (LEFT_EYE, 1, -14.0),
    "eyeLookInRight": (RIGHT_EYE, 1, 14.0),
    "eyeLookOutLeft": (LEFT_EYE, 1, 14.0),
    "eyeLookOutRight": (RIGHT_EYE, 1, -14.0),
}
"""Shape -> joint, axis, and degrees at coefficient 1."""


def turned(points: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """How FACE_NAMES move points [M,3] m, [52,M,3] m: as jaw and eyes at joints [3,3] m with weights [M,3] do; others by 0."""
    shapes = np.zeros((len(FACE_NAMES), *points.shape))
    for name, (joint, axis, degrees) in TURNS.items():
        turn = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix() - np.eye(3)
        shapes[FACE_NAMES.index(name)] = weights[:, joint, None] * ((points - joints[joint]) @ turn.T)
    return shapes


def coefficients(turns: np.ndarray) -> tuple[np.ndarray, int]:
    """Coefficients [F,52], 0 to 1, of turns [F,3,3] rad of jaw, left and right eye, and how many of them were beyond."""
    face, beyond = np.zeros((len(turns), len(FACE_NAMES))), int((turns[:, JAW, 0] < -SLACK).sum())
    for name, (joint, axis, degrees) in TURNS.items():
        whole = np.radians(degrees)
        share = turns[:, joint, axis] / whole
        beyond += int((share > 1 + SLACK / abs(whole)).sum())
        face[:, FACE_NAMES.index(name)] = share.clip(0, 1)
    return face, beyond

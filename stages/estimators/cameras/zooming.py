"""A camera on a tripod that only zooms: one scale a pair of frames says how the whole background moves.

A walk straight towards a flat wall looks the same, and shows no more depth.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import lsqr

from stages.estimators.cameras.motion import MIN_MATCHES, ROTATION_PX, ROTATION_SHARE, Pair

FAR = 80  # pairs that must be explained: those that move most
ROUNDS = 3  # of Cauchy weights


def zoom_alone(pairs: list[Pair], count: int, width: int, height: int) -> np.ndarray | None:
    """Focal length of each frame [count], the first seen having 1, NaN where no pair joins it; None if more moves than a zoom.

    As for a turn, a zoom must explain the farthest `pairs` to ROTATION_PX of the longer side and ROTATION_SHARE of the motion.
    """
    told, side = [pair for pair in pairs if len(pair.a) >= MIN_MATCHES], max(width, height)
    if not told:
        return None
    center = np.array([width, height]) / 2
    fits = [_scale(pair.a - center, pair.b - center) for pair in told]
    moved = np.array([np.median(np.linalg.norm(pair.a - pair.b, axis=1)) for pair in told])
    far = np.argsort(-moved, kind="stable")[:FAR]
    left = float(np.median([fits[i][1] for i in far]))
    if left > min(ROTATION_PX * side, ROTATION_SHARE * float(np.median(moved[far]))):
        return None
    ends = np.array([[pair.first, pair.second] for pair in told])
    weight, rows = np.sqrt([len(pair.a) for pair in told]), np.arange(len(told)).repeat(2)
    joins = coo_array(((weight[:, None] * [-1, 1]).ravel(), (rows, ends.ravel())), shape=(len(told), count))
    zoom = lsqr(joins, weight * np.log([scale for scale, _ in fits]), atol=1e-10, btol=1e-10)[0]
    seen = np.zeros(count, bool)
    seen[ends] = True
    return np.where(seen, np.exp(zoom - zoom[np.argmax(seen)]), np.nan)


def _scale(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """The scale that takes points `a` [N,2] to `b`, and the median distance in px that it leaves."""
    weights = np.ones(len(a))
    for _ in range(ROUNDS):
        scale = (weights[:, None] * a * b).sum() / (weights[:, None] * a * a).sum()
        off = np.linalg.norm(scale * a - b, axis=1)
        weights = 1 / (1 + off**2)
    return float(scale), float(np.median(off))

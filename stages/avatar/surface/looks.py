"""Cameras all around a figure, as a scanner has them: near enough to parallel that no side hides another by perspective."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.avatar.rasterize import Camera

RINGS = ((0.0, 12, 0.0), (35.0, 8, 0.5), (-30.0, 8, 0.5), (70.0, 4, 0.0), (-65.0, 4, 0.0))
"""Height of a ring of cameras in degrees, how many it has, and where the first stands, in shares of a step; 0 is ahead."""
AWAY = 3.0  # radii of the figure


def all_around(points: np.ndarray, side: int, rings: Sequence[tuple[float, int, float]] = RINGS) -> list[Camera]:
    """Cameras that look at points [N,3] m, y up, from RINGS; pictures are `side` px square and hold all points."""
    middle = (points.min(0) + points.max(0)) / 2
    radius = float(np.linalg.norm(points - middle, axis=1).max()) + 0.05
    focal = side / 2 * np.sqrt(AWAY**2 - 1)
    K = np.array([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    cameras = []
    for height, count, first in rings:
        for angle in 2 * np.pi * (np.arange(count) + first) / max(count, 1):
            level, rise = np.cos(np.radians(height)), np.sin(np.radians(height))
            ahead = -np.array([level * np.sin(angle), rise, level * np.cos(angle)])
            right = np.array([np.cos(angle), 0, -np.sin(angle)])
            view = np.eye(4)
            view[:3, :3] = right, np.cross(ahead, right), ahead
            view[:3, 3] = [0, 0, AWAY * radius] - view[:3, :3] @ middle
            cameras.append(Camera.of(view, K, side, side))
    return cameras

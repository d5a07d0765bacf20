"""Cameras around a person, in a frame whose y is up."""

from __future__ import annotations

import numpy as np

from stages.avatar.rasterize import Camera

SIDE = 640  # px
FOCAL = 2.2  # of the side
AWAY = 2.7  # of the person's height
STAND = {2: 0.25, 5: -0.25, 47: -0.9, 50: 0.9}  # entries of body_pose, rad


def standing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """global_orient [3], body_pose [69] in rad and transl [3] of a relaxed stand at the origin, looking along z."""
    stand = np.zeros(69)
    stand[list(STAND)] = list(STAND.values())
    return np.zeros(3), stand, np.zeros(3)


def around(means: np.ndarray, count: int) -> list[Camera]:
    """`count` cameras on a circle around a standing person's Gaussians [N,3], the first before them."""
    low, high = np.percentile(means, 1, axis=0), np.percentile(means, 99, axis=0)
    away = AWAY * max(high - low)
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        cos, sin = np.cos(angle), np.sin(angle)
        view = np.eye(4)
        view[:3, :3] = np.diag([1.0, -1, -1]) @ [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
        view[:3, 3] = [0, 0, away] - view[:3, :3] @ ((low + high) / 2)
        cameras.append(Camera.of(view, _lens(), SIDE, SIDE))
    return cameras


def _lens() -> np.ndarray:
    return np.array([[FOCAL * SIDE, 0, SIDE / 2], [0, FOCAL * SIDE, SIDE / 2], [0, 0, 1]])

"""Sky and whatever is too far away for parallax: a shell of Gaussians around the scene, where SfM has no points.

Without it, pixels of the sky get the depth of the nearest thing that SfM saw and stand before it in every other view.
"""

from __future__ import annotations

import math

import numpy as np

RADIUS = 30.0  # scene extents; cameras move by less than one, so a pixel of 0.1 degrees shifts by under 20
CELLS = 24  # along the longer side, to look for SfM points in
SPACING = 1.0  # of the distance between directions: the shell's Gaussians overlap and leave no holes


def open_sky(points: np.ndarray, mask: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Pixels bool[H,W] from the top border down to the first SfM point of their column, the person[mask>=128] left out.

    points[P,3] m, mask uint8[H,W], viewmat[4,4], K[3,3] px. Columns are CELLS wide; pictures are taken to stand upright.
    """
    height, width = mask.shape
    cell = max(1, round(max(height, width) / CELLS))
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    local = local[local[:, 2] > 1e-6]
    at = local[:, :2] / local[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    column, row = at[(at >= 0).all(1) & (at < [width, height]).all(1)].astype(int).T // cell
    taken = np.zeros((math.ceil(height / cell), math.ceil(width / cell)), bool)
    taken[row, column] = True
    free = ~np.logical_or.accumulate(taken, 0)
    return np.kron(free, np.ones((cell, cell), bool))[:height, :width] & (mask < 128)

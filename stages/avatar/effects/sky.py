"""Sky and all that is too far away for parallax: a shell of Gaussians around the scene, where SfM has no points.

Without the shell, sky pixels get the depth of the nearest SfM point and hide it in every other view. Gaussians on the
shell are like all others of the scene, but their size counts as an angle.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import label

from stages.avatar.cameras.pinhole import camera_centers, onto, project

RADIUS = 300.0  # extents: a camera that moves by one sees the shell turn by 0.2 degrees
DIRECTIONS = 60_000  # over the whole sphere: 0.8 degrees apart, which training divides where it needs to
CELLS = 24  # along a picture's longer side, to look for SfM points in


def open_sky(points: np.ndarray, mask: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Pixels bool[H,W] off the person, in cells without SfM points[P,3] m that connect to the top border.

    mask uint8[H,W] (255 = person), viewmat[4,4], K[3,3] px. It assumes an upright picture.
    """
    height, width = mask.shape
    cell = max(1, round(max(height, width) / CELLS))
    at, depths = project(points, viewmat, K)
    seen = (depths > 1e-6) & (at >= 0).all(1) & (at < [width, height]).all(1)
    column, row = at[seen].astype(int).T // cell
    free = np.ones((math.ceil(height / cell), math.ceil(width / cell)), bool)
    free[row, column] = False
    regions, _ = label(free)
    joined = free & np.isin(regions, regions[0])
    return np.kron(joined, np.ones((cell, cell), bool))[:height, :width] & (mask < 128)


def shell(
    skies: list[np.ndarray], images: list[np.ndarray], viewmats: np.ndarray, Ks: np.ndarray, extent: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [N,3] m on the shell, in directions that a view sees in its open sky, their mean colours [N,3] in 0..1, and
    the middle [3] of the shell.

    Per view: sky bool[H,W], image uint8[H,W,3], viewmat[4,4], K[3,3] px. Lengths go by the scene's `extent` m.
    """
    up = 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    turn = np.arange(DIRECTIONS) * np.pi * (3 - math.sqrt(5))  # the golden angle
    level = np.sqrt(1 - up**2)
    ways = np.stack([level * np.cos(turn), up, level * np.sin(turn)], 1)
    colours, seen = np.zeros((DIRECTIONS, 3)), np.zeros(DIRECTIONS)
    for sky, image, viewmat, K in zip(skies, images, viewmats, Ks, strict=True):
        local = ways @ viewmat[:3, :3].T  # directions have no place to project
        ahead = (local[:, 2] > 1e-3).nonzero()[0]
        at = onto(local[ahead], K)
        inside = (at >= 0).all(1) & (at < [sky.shape[1], sky.shape[0]]).all(1)
        rows, (column, row) = ahead[inside], at[inside].astype(int).T
        rows, row, column = (part[sky[row, column]] for part in (rows, row, column))
        colours[rows] += image[row, column] / 255
        seen[rows] += 1
    kept = seen > 0
    middle = camera_centers(viewmats).mean(0)
    return middle + RADIUS * extent * ways[kept], colours[kept] / seen[kept, None], middle

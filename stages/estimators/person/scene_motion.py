"""How the static scene moves between the frames of a clip, by the pictures alone: corners around the person are followed.

A homography says most of it; what it leaves, mostly parallax, a pixel has from the corners that are nearest.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import KDTree

from stages.estimators.corners import Choice, follow

CORNERS = Choice(most=3000, apart=5, quality=0.005, returns=1.0)
HIDDEN = 60  # of 255, from which on a pixel may be the person
BESIDE = 2  # px around the hidden ones, in which a corner may be the outline, which moves with the person
FEW = 12  # corners in both frames that move by one homography: fewer do not tell it
OFF = 2.0  # px that a corner may be off a homography that it tells
NEIGHBOURS, STRAY = 20, 3.0  # a corner that moves this many px otherwise than the middle one of these is left out
NEAREST = 5  # corners that a pixel's motion is the mean of, by their distance
STEP = 8  # px; at each the mean is taken
AROUND = 40  # px beyond the window, in which corners count


class SceneMotion:
    """The motion of a clip's scene: `grey` and `hidden` F of uint8 [h,w] in order of time, 255 where somebody hides the scene."""

    def __init__(self, grey: Sequence[np.ndarray], hidden: Sequence[np.ndarray]):
        free = (cv2.dilate(mask, disk(BESIDE)) < HIDDEN for mask in hidden)
        self.corners = follow(zip(grey, free, strict=True), CORNERS)

    def places(self, frame: int, other: int, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray] | None:
        """Where the scene of a window of `frame` lies in `other`, also behind the person: columns and rows float32 [h,w] px.

        None if the two frames share too few corners.
        """
        (mine, here), (theirs, there) = self.corners[frame], self.corners[other]
        _, i, j = np.intersect1d(mine, theirs, assume_unique=True, return_indices=True)
        here, there = here[i], there[j]
        if len(here) < FEW:
            return None
        way, sure = cv2.findHomography(here, there, cv2.USAC_MAGSAC, OFF)
        ends = [[x, y, 1] for x in (columns.start, columns.stop) for y in (rows.start, rows.stop)]
        if way is None or sure.sum() < FEW or (np.array(ends) @ way[2] <= 0).any():  # behind the camera
            return None
        low = np.array([columns.start, rows.start]) - AROUND
        high = np.array([columns.stop, rows.stop]) + AROUND
        near = ((here > low) & (here < high)).all(1)
        here, there = here[near], there[near]
        v, u = np.mgrid[rows, columns].astype(np.float32)
        pixels = cv2.perspectiveTransform(np.dstack([u, v]), way)
        if len(here) >= NEAREST:
            left = there - cv2.perspectiveTransform(here[:, None], way)[:, 0]
            pixels = pixels + spread(*without_strays(here, left), rows, columns)
        return pixels[..., 0], pixels[..., 1]


def disk(radius: float) -> np.ndarray:
    """A structuring element of this radius in px."""
    side = 2 * round(radius) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def without_strays(points: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of `points` [N,2] px and their `motion` [N,2] px that move as their neighbours do."""
    near = KDTree(points).query(points, min(NEIGHBOURS, len(points)))[1]
    alike = np.linalg.norm(motion - np.median(motion[near], 1), axis=1) < STRAY
    return points[alike], motion[alike]


def spread(points: np.ndarray, motion: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
    """The `motion` [N,2] of `points` [N,2] px carried to all pixels of a window, float32 [h,w,2]; zero with too few points."""
    height, width = rows.stop - rows.start, columns.stop - columns.start
    if len(points) < NEAREST:
        return np.zeros((height, width, 2), np.float32)
    y, x = (np.arange(side.start // STEP - 1, side.stop // STEP + 2) for side in (rows, columns))
    away, near = KDTree(points).query(STEP * np.stack(np.meshgrid(x, y), -1) + (STEP - 1) / 2, NEAREST)
    weight = 1 / (away + 1) ** 2
    mean = ((weight[..., None] * motion[near]).sum(-2) / weight.sum(-1)[..., None]).astype(np.float32)
    whole = cv2.resize(mean, None, fx=STEP, fy=STEP, interpolation=cv2.INTER_LINEAR)
    top, left = rows.start - STEP * int(y[0]), columns.start - STEP * int(x[0])
    return whole[top : top + height, left : left + width]

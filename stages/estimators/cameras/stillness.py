"""Whether the camera stands still, in a second or two and before any features: corners that stay where they are.

A standing camera shows it by what stays, not by what moves: spectators, trees or a screen behind the person may cover
most of the picture. A camera in a hand leaves nothing where it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from stages.estimators.cameras.motion import STATIC_PX
from stages.formats.images import read_image, read_mask

LOOKED_AT = 12  # frames, evenly spread; each is compared with those 1, 2, 4 and 8 of these later
CORNERS, APART = 25, 0.012  # at most in a cell; of the longer side between two
WINDOW = (15, 15)  # px that are compared around a corner
RETURNS, ALIKE = (
    0.5,
    15.0,
)  # px that a corner tracked there and back may be off; grey levels that its window may differ by
MOST, SOME = 0.5, 0.1  # share of corners that stay: with most the camera stands still; with some, if the rest agrees
CELLS, STAYS, COVERED = 4, 0.2, 0.15  # the picture is cut into 4 by 4; this share must stay in this share of the cells
ONE_WAY = 0.7  # length of the mean direction: what moves past a camera that slides moves one way, a crowd does not
FEW = 20  # corners: fewer say nothing


@dataclass(frozen=True)
class Stillness:
    """Share of the corners that stay and of cells where some do, at the gap where they are fewest.

    `one_way` 0..1 says how much what moves goes one way; `drift_px` is how far corners that stay are apart (median).
    """

    stays: float
    cells: float
    one_way: float
    drift_px: float

    @property
    def still(self) -> bool:
        """Whether the camera stands still."""
        return self.stays >= MOST or (self.stays >= SOME and self.cells >= COVERED and self.one_way < ONE_WAY)


def measure_stillness(images: Path, ignored: Path, files: list[str]) -> Stillness | None:
    """Follow corners outside the person between frames of the whole clip; None if there are too few corners to tell.

    `ignored` has a mask of the same name for each picture, 0 = not looked at.
    """
    chosen = np.unique(np.linspace(0, len(files) - 1, LOOKED_AT).round().astype(int))
    frames = []
    for file in (files[i] for i in chosen):
        grey = cv2.cvtColor(read_image(images / file), cv2.COLOR_RGB2GRAY)
        seen = read_mask(ignored / file) > 0
        frames.append((grey, seen, _corners(grey, seen)))
    rows = []
    for gap in (1, 2, 4, 8):
        found = [_compare(first, second) for first, second in zip(frames, frames[gap:])]
        if known := [row for row in found if row is not None]:
            rows.append(np.nanmedian(known, axis=0))
    if not rows:
        return None
    stays, cells, _, drift = np.array(rows).T
    return Stillness(float(stays.min()), float(cells.min()), float(rows[0][2]), float(drift.max()))


def _corners(grey: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Corners [N,2] px, as many in each cell: a crowd has more of them than the ground before it."""
    found: list[np.ndarray] = [np.zeros((0, 2), np.float32)]
    bounds = [np.linspace(0, side, CELLS + 1).round().astype(int) for side in grey.shape]
    for top, bottom in zip(bounds[0], bounds[0][1:]):
        for left, right in zip(bounds[1], bounds[1][1:]):
            cell = np.s_[top:bottom, left:right]
            here = cv2.goodFeaturesToTrack(
                grey[cell], CORNERS, 0.02, APART * max(grey.shape), mask=seen[cell].astype(np.uint8)
            )
            if here is not None:
                found.append((np.asarray(here)[:, 0] + [left, top]).astype(np.float32))
    return np.concatenate(found)


def _compare(
    first: tuple[np.ndarray, np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[float, float, float, float] | None:
    """`Stillness` of two frames (grey, seen, corners), or None for too few corners."""
    (grey, _, corners), (other, seen, _) = first, second
    x, y = corners.astype(int).T
    corners = corners[seen[y, x]]
    if len(corners) < FEW:
        return None
    there, found, off = cv2.calcOpticalFlowPyrLK(grey, other, corners, corners.copy(), winSize=WINDOW)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, grey, there, there.copy(), winSize=WINDOW)
    sure = (np.ravel(found) == 1) & (np.ravel(returned) == 1) & (np.ravel(off) < ALIKE)
    sure &= np.linalg.norm(np.asarray(back) - corners, axis=1) < RETURNS
    way = np.asarray(there) - corners
    moved = np.linalg.norm(way, axis=1)
    limit = STATIC_PX * max(grey.shape)
    stays, goes = sure & (moved < limit), sure & (moved > 3 * limit)
    cell = (corners / grey.shape[::-1] * CELLS).astype(int) @ [1, CELLS]
    share = [stays[cell == i].mean() for i in np.unique(cell) if (cell == i).sum() >= CELLS]
    mean = (way[goes] / moved[goes, None]).mean(0) if goes.sum() >= FEW else np.zeros(2)
    drift = float(np.median(moved[stays])) if stays.any() else 0.0
    return float(stays.mean()), float(np.mean(np.array(share) >= STAYS)), float(np.linalg.norm(mean)), drift

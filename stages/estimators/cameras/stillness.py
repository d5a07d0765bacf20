"""Whether the camera stands still, in a second or two and before any features: corners that stay where they are.

A standing camera shows it by what stays, not by what moves: spectators, trees or a screen behind the person may cover
most of the picture. A camera in a hand leaves nothing where it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from stages.estimators.cameras.motion import STATIC_PX
from stages.estimators.corners import Choice, follow_pair
from stages.formats.images import evenly, read_image, read_mask

LOOKED_AT = 12  # frames, evenly spread; each is compared with those 1, 2, 4 and 8 of these later
CORNERS = Choice(most=1600, apart=0, quality=0.01, returns=0.5)
APART = 0.012  # of the longer side between two corners
MOST, SOME = 0.5, 0.1  # share of a cell's corners that stay: most, the camera stands still; some, if the rest agrees
CELLS, STAYS, COVERED = 4, 0.2, 0.15  # the picture is cut into 4 by 4; this share must stay in this share of the cells
ONE_WAY = 0.7  # length of the mean direction: what moves past a camera that slides moves one way, a crowd does not
FEW = 20  # corners: fewer say nothing


@dataclass(frozen=True)
class Stillness:
    """Share of the corners that stay, a cell's mean, and of cells where some do, at the gap where they are fewest.

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
    chosen = [files[i] for i in evenly(len(files), LOOKED_AT)]
    frames = [(cv2.cvtColor(read_image(images / f), cv2.COLOR_RGB2GRAY), read_mask(ignored / f) > 0) for f in chosen]
    rows = []
    for gap in (1, 2, 4, 8):
        found = [_compare(first, second) for first, second in zip(frames, frames[gap:])]
        if known := [row for row in found if row is not None]:
            rows.append(np.nanmedian(known, axis=0))
    if not rows:
        return None
    stays, cells, _, drift = np.array(rows).T
    return Stillness(float(stays.min()), float(cells.min()), float(rows[0][2]), float(drift.max()))


def _compare(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float, float, float] | None:
    """`Stillness` of two frames (grey, seen), or None for too few corners."""
    size = np.array(first[0].shape[::-1])
    corners, there = follow_pair(first, second, replace(CORNERS, apart=max(round(APART * size.max()), 1)))
    x, y = corners.astype(int).T
    seen = second[1][y, x]
    corners, there = corners[seen], there[seen]
    if len(corners) < FEW:
        return None
    moved, limit = np.linalg.norm(there - corners, axis=1), STATIC_PX * size.max()
    stays, goes = moved < limit, moved > 3 * limit
    cell = (corners / size * CELLS).astype(int) @ [1, CELLS]
    share = [stays[cell == i].mean() for i in np.unique(cell) if (cell == i).sum() >= CELLS]
    if not share:
        return None
    mean = ((there - corners)[goes] / moved[goes, None]).mean(0) if goes.sum() >= FEW else np.zeros(2)
    drift = float(np.median(moved[stays])) if stays.any() else 0.0
    return float(np.mean(share)), float(np.mean(np.array(share) >= STAYS)), float(np.linalg.norm(mean)), drift

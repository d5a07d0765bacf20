"""Follows objects without ids from picture to picture by the overlap of their boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

OVERLAP = 0.2
"""Intersection over union of boxes from which an object is the same as one seen before."""


class BoxTracker:
    """Gives each object an id, counted from 1; an object whose box overlaps an earlier one keeps that one's id."""

    def __init__(self) -> None:
        self.last: dict[str, np.ndarray] = {}

    def add(self, boxes: Sequence[np.ndarray]) -> list[tuple[str, int]]:
        """(id, place in `boxes`) of each object of the next picture, the largest box first; boxes are [4] as in `box_of`."""
        free, found = dict(self.last), []
        for place in sorted(range(len(boxes)), key=lambda place: -boxes[place][2:].prod()):
            box = boxes[place]
            best = max(free, key=lambda known: intersection_over_union(free[known], box), default="")
            if not best or intersection_over_union(free[best], box) < OVERLAP:
                best = str(len(self.last) + 1)
            free.pop(best, None)
            self.last[best] = box
            found.append((best, place))
        return found


def box_of(mask: np.ndarray) -> np.ndarray:
    """x, y, width, height in px of the marked pixels of [H,W]; zeros if there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return np.zeros(4)
    return np.array([columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1], np.float64)


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boxes x, y, width, height."""
    shared = (np.minimum(a[:2] + a[2:], b[:2] + b[2:]) - np.maximum(a[:2], b[:2])).clip(0).prod()
    return float(shared / max(a[2:].prod() + b[2:].prod() - shared, 1e-9))

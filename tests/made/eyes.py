"""Eyes in place of the network that sees people: pictures of patches of one colour, and who is seen in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.estimators.person.blazepose import NAMES, TORSO, BlazePose, Pose
from stages.estimators.person.crops import Roi
from stages.estimators.person.sightings import PAINT

HEIGHT, WIDTH, FRAMES, SIDE = 60, 200, 21, 40
RED, BLUE = (200, 40, 40), (40, 40, 200)
OUTLINE = np.full((SIDE, SIDE), -9.0)
OUTLINE[:, 12:28] = 9  # of a patch 16 px wide in the middle of its crop


def pose_at(x: float) -> Pose:
    """Somebody whose crop is SIDE wide, with a trunk and thighs around x."""
    xy = np.full((len(NAMES), 2), [x, 30.0])
    xy[TORSO] = [[x - 5, 20], [x - 5, 30], [x + 5, 20], [x + 5, 30]]
    xy[[25, 26]] = [[x - 5, 42], [x + 5, 42]]
    roi = Roi(x, 30.0, SIDE, 0.0)
    return Pose(xy, np.ones(33), np.zeros((33, 3)), 1.0, roi, roi)


class Eyes:
    """In place of the network: people are patches of one colour, and in a crop it sees the one nearest to its middle."""

    def places(self, image: np.ndarray) -> list[float]:
        found = []
        for ink in {tuple(one) for one in image[30].tolist()} - {(0, 0, 0), (PAINT, PAINT, PAINT)}:
            columns = np.flatnonzero((image == ink).all(2).any(0))
            parts = np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1)
            found += [float(part.mean()) for part in parts if len(part) > 6]
        return found

    def look(self, image: np.ndarray, roi: Roi) -> tuple[Pose, np.ndarray]:
        near = min(self.places(image), key=lambda x: abs(x - roi.x), default=np.inf)
        there = abs(near - roi.x) < SIDE / 2
        return (pose_at(near) if there else replace(pose_at(roi.x), presence=0.0)), OUTLINE

    def average_looks(self, image: np.ndarray, roi: Roi) -> Pose | None:
        pose, _ = self.look(image, roi)
        return pose if pose.presence else None

    read = BlazePose.read

    def detect(self, image: np.ndarray, window: Roi | None = None, least: float = 0.5) -> list[tuple[float, Roi]]:
        return [(0.9, pose_at(x).next_roi) for x in self.places(image)]


def filmed(inks: tuple, ways: tuple[np.ndarray, np.ndarray]) -> list[np.ndarray]:
    """Frames of two people 16 px wide, the first before the second; NaN: not in the picture."""
    images = []
    for there in zip(*ways, strict=True):
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for ink, x in list(zip(inks, there, strict=True))[::-1]:
            if np.isfinite(x):
                image[10:50, round(x) - 8 : round(x) + 8] = ink
        images.append(image)
    return images

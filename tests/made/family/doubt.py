"""Whether the body fit knows how far it is off: what it expects beside what is measured, in ten bins of what it expects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.records import BodyModel, BodyPoses, Cameras
from tests.made.family.evidence import Truth
from tests.made.family.measures import between
from tests.made.truth import joints_of, rows

BINS = 10


def errors_of(poses: BodyPoses, model: BodyModel, cameras: Cameras, moving: bool, truth: Truth) -> np.ndarray:
    """How far each joint is off [F,24,2] m, along the view and across it."""
    wanted = joints_of(truth.poses, truth.model)[rows(poses.names, truth.poses.names)]
    ours, views = joints_of(poses, model), truth.cameras.viewmats[rows(poses.names, truth.cameras.names)]
    similarity = between(poses, cameras, moving, truth, ours, wanted)
    gap = similarity.to_truth(ours) - wanted
    away = wanted + (views[:, :3, :3].mT @ views[:, :3, 3:])[..., 0][:, None]
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    along = (gap * away).sum(-1)
    return np.stack([abs(along), np.linalg.norm(gap - along[..., None] * away, axis=-1)], -1)


def in_bins(expected: Sequence[np.ndarray], found: Sequence[np.ndarray]) -> np.ndarray:
    """Root mean squares [2,BINS,2] cm, along and across the view: expected, measured, in bins of equal counts."""
    all_expected, all_found = (np.concatenate([part.reshape(-1, 2) for part in parts]) for parts in (expected, found))
    table = np.zeros((2, BINS, 2))
    for k in range(2):
        order = np.array_split(all_expected[:, k].argsort(), BINS)
        for i, rows_ in enumerate(order):
            table[k, i] = [100 * np.sqrt((values[rows_, k] ** 2).mean()) for values in (all_expected, all_found)]
    return table

"""Sky and infinity: does part of the background stay where it is however the camera moves?"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from stages.avatar.cameras.pinhole import camera_centers
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.estimators.detectors.tracks import Tracks

SHARE = 0.03
UNIT = "of the picture"
FAR = 8.0  # times the median depth: from there a point counts as infinitely far
EXPECTED = np.radians(2.0)  # the angle at which the median depth must have been seen before a point is called far
GRID = 32  # cells along the longer side


def detect(evidence: ClipEvidence) -> Finding:
    """The share of the picture whose nearest followed point is infinitely far.

    A sky without clouds has no points; it counts by the far hills, trees or houses at its lower edge. What is plain but
    near, a white ceiling, does not.
    """
    if not evidence.moving:
        return unmeasured(UNIT, SHARE, "the camera does not move")
    clip, tracks = evidence.clip, evidence.tracks
    told, far = find_infinite(tracks, clip.viewmats)
    if told.sum() < 40:
        return unmeasured(UNIT, SHARE, "too few points are seen long enough")
    cell = max(clip.width, clip.height) / GRID
    x, y = np.meshgrid(np.arange(cell / 2, clip.width, cell), np.arange(cell / 2, clip.height, cell))
    grid, shares = np.stack([x.ravel(), y.ravel()], 1), np.full(len(clip.names), np.nan)
    for i in evidence.sampled:
        here = tracks.seen[i] & told
        if here.sum() >= 10:
            free = clip.mask(i)[grid[:, 1].astype(int), grid[:, 0].astype(int)] <= 64
            nearest = cKDTree(tracks.pixels[i, here]).query(grid)[1]
            shares[i] = (far[here][nearest] & free).mean()
    if np.isnan(shares).all():
        return unmeasured(UNIT, SHARE, "too few points are seen in each frame")
    return compare(
        np.nanmedian(shares), UNIT, SHARE, ("open to the sky", "closed in"), strongest_frames(clip.names, shares)
    )


def find_infinite(tracks: Tracks, viewmats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """bool [T] of points whose distance can be told, and of those among them that are infinitely far."""
    centers, order = camera_centers(viewmats), np.arange(len(viewmats))[:, None]
    first = np.where(tracks.seen, order, len(viewmats)).min(0).clip(0, len(viewmats) - 1)
    last = np.where(tracks.seen, order, 0).max(0)
    baseline = np.linalg.norm(centers[last] - centers[first], axis=1)
    away = np.linalg.norm(tracks.points - centers[first], axis=1)
    usual = np.nanmedian(away[np.isfinite(away)]) if np.isfinite(away).any() else np.nan
    told = baseline / usual > EXPECTED
    behind = ~np.isfinite(away)  # no point is in front of all cameras: rays spread
    return told, told & (behind | (away > FAR * usual))

"""Lens distortion: what SfM took out, and what is still in the frames."""

from __future__ import annotations

import numpy as np

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

SHIFT_PX = 1.2  # of a corner; a bent world and a bent lens look alike, so less than this is not to be told apart
SIGMAS = 3.0
UNIT = "px at the corners"


def detect(evidence: ClipEvidence) -> Finding:
    """How far the lens moves a corner: by the cameras' own distortion, or by one that the tracks show beyond it."""
    removed, left = evidence.facts.distortion.max_shift_px, evidence.residuals
    if left is None and removed <= SHIFT_PX:
        return unmeasured(UNIT, SHIFT_PX, "too few points could be placed")
    K = evidence.clip.Ks[0]
    corner = np.linalg.norm(K[:2, 2] / [K[0, 0], K[1, 1]])
    shift = 0.0 if left is None or abs(left.k) < SIGMAS * left.k_std else abs(left.k) * corner**3 * K[0, 0]
    where = "taken out by sfm" if removed >= shift else "still in the frames"
    return compare(max(removed, shift), UNIT, SHIFT_PX, (f"bends, {where}", "straight"), widest(evidence))


def widest(evidence: ClipEvidence) -> list[str]:
    """The frames in which a point of the background is farthest from the middle, where a lens shows most."""
    away = np.linalg.norm(evidence.tracks.pixels - evidence.clip.Ks[0, :2, 2], axis=2)
    return strongest_frames(evidence.clip.names, np.where(evidence.tracks.seen, away, -np.inf).max(1, initial=-np.inf))

"""Exposure and white balance: does the background's brightness drift or jump?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from stages.avatar.cameras import project
from stages.estimators.detectors.finding import Finding, above, strongest, unknown
from stages.estimators.detectors.pictures import brightness

if TYPE_CHECKING:
    from stages.estimators.detectors.evidence import Evidence
    from stages.formats.clip import Clip

STD, STEP = 0.02, 0.05  # of the log gain: over the clip, and between neighbouring frames
UNIT = "std of the log gain"
MIN_SAMPLES = 30  # points that must be seen in a frame before its exposure is believed


def detect(evidence: Evidence) -> Finding:
    """The standard deviation of the log gain; a single jump of more than STEP calls for it too."""
    gains = evidence.gains
    seen = gains[np.isfinite(gains)]
    if len(seen) < 3:
        return unknown(UNIT, STD, "too few points of the background")
    step = np.abs(np.diff(seen)).max()
    return above(max(seen.std(), step * STD / STEP), UNIT, STD, ("drifts", "steady"),
                 strongest(evidence.clip.names, np.abs(gains)))  # fmt: skip


def gains_of(clip: Clip) -> np.ndarray:
    """Log gain [F] of each frame, from the colours of SfM points outside the person."""
    logs = np.full((len(clip.names), len(clip.points)), np.nan)
    for i in range(len(clip.names) if len(clip.points) else 0):
        pixels, z = project(clip.points, clip.viewmats[i], clip.Ks[i])
        logs[i] = point_logs(clip.images(i), clip.mask(i), pixels, z)
    return robust_gains(logs)


def point_logs(image: np.ndarray, mask: np.ndarray, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Log brightness [P] of a frame at `pixels` [P,2]; NaN outside it, on the person, and where clipped or dark."""
    height, width = mask.shape
    grey = brightness(image)
    person = cv2.dilate(mask, np.ones((9, 9), np.uint8)) > 64
    inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [width, height]).all(1)
    x, y = np.where(inside[:, None], pixels, 0).astype(int).T
    value = grey[y, x]
    usable = inside & ~person[y, x] & (value > 20) & (value < 235)
    return np.where(usable, np.log(np.where(usable, value, 1.0)), np.nan)


def robust_gains(logs: np.ndarray) -> np.ndarray:
    """Log gain [F] of each frame from log brightness [F,P] with NaN gaps: medians in turn, the mean gain being 0.

    NaN for a frame with fewer than MIN_SAMPLES points. Median polish (Tukey 1977) copes with hidden points.
    """
    gains = np.full(len(logs), np.nan)
    enough = np.isfinite(logs).sum(1) >= MIN_SAMPLES
    logs = logs[enough]
    logs = logs[:, np.isfinite(logs).sum(0) >= 3]
    if not logs.size or (np.isfinite(logs).sum(1) == 0).any():
        return gains
    found = np.zeros(len(logs))
    for _ in range(10):
        level = np.nanmedian(logs - found[:, None], axis=0)
        found = np.nanmedian(logs - level, axis=1)
        found -= found.mean()
    gains[enough] = found
    return gains

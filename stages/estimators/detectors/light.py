"""How bright each frame is, and of which tint: log gains from the SfM points of the background."""

from __future__ import annotations

import cv2
import numpy as np

from stages.avatar.cameras.pinhole import project
from stages.estimators.detectors.pictures import brightness, soften
from stages.formats.clip import Clip

MIN_SAMPLES = 30  # points that must be seen in a frame before its exposure is believed


def frame_gains(clip: Clip) -> np.ndarray:
    """Log gains [F,3] of each frame: brightness, red / green and blue / green; from SfM points outside the person."""
    logs = np.full((3, len(clip.names), len(clip.points)), np.nan)
    for i in range(len(clip.names) if len(clip.points) else 0):
        pixels, z = project(clip.points, clip.viewmats[i], clip.Ks[i])
        logs[:, i] = point_logs(clip.images(i), clip.mask(i), pixels, z)
    return np.stack([robust_gains(one) for one in logs], 1)


def point_logs(image: np.ndarray, mask: np.ndarray, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Log [3,P] of brightness, red / green and blue / green of a frame at `pixels` [P,2].

    NaN outside it, on the person, and where brightness, or any of the colours, is clipped or dark.
    """
    height, width = mask.shape
    person = cv2.dilate(mask, np.ones((9, 9), np.uint8)) > 64
    inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [width, height]).all(1)
    x, y = np.where(inside[:, None], pixels, 0).astype(int).T
    values = np.column_stack([brightness(image)[y, x], soften(image)[y, x]])
    clear = (values > 20) & (values < 235) & (inside & ~person[y, x])[:, None]
    grey, red, green, blue = np.where(clear, np.log(np.where(clear, values, 1.0)), np.nan).T
    return np.stack([grey, red - green, blue - green])


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

"""Transients: does something beside the person move through the background?"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.estimators.detectors.pictures import background_mask
from stages.estimators.detectors.tracks import SIDE

AREA = 0.005  # of the picture
SHARE = 0.1  # of the frames in which as much must be unexplained
UNIT = "of the picture, in a tenth of the frames"
NEAR = 7  # px: a neighbouring frame explains a pixel if it has the like within this window
LIKE = 14.0  # of 255
BLOB = 7  # px: narrower than this are edges that come into view behind others
GRID = 16  # px between the points at which the motion is interpolated


def detect(evidence: ClipEvidence) -> Finding:
    """The area that neither neighbour explains once the background's motion is undone, in a tenth of the frames."""
    clip = evidence.clip
    areas = np.full(len(clip.names), np.nan)
    for i in evidence.sampled:
        if 0 < i < len(clip.names) - 1:
            areas[i] = unexplained_share(evidence, i)
    known = areas[np.isfinite(areas)]
    if len(known) < 4:
        return unmeasured(UNIT, AREA, "too few points are followed")
    return compare(
        np.quantile(known, 1 - SHARE), UNIT, AREA, ("something moves", "still"), strongest_frames(clip.names, areas)
    )


def unexplained_share(evidence: ClipEvidence, i: int) -> float:
    """The share of frame `i` that both neighbours lack; NaN if they cannot be warped onto it."""
    here, free = _picture(evidence, i)
    lacking = free
    for j in (i - 1, i + 1):
        moved = _warp_neighbour(evidence, i, j)
        if moved is None:
            return np.nan
        other, valid = moved
        window = np.ones((NEAR, NEAR), np.uint8)
        low, high = cv2.erode(other, window) - LIKE, cv2.dilate(other, window) + LIKE
        unlike = ((here < low) | (here > high)).any(-1)
        lacking = lacking & valid & unlike
    blobs = cv2.morphologyEx(lacking.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    blobs = cv2.morphologyEx(blobs, cv2.MORPH_OPEN, np.ones((BLOB, BLOB), np.uint8))
    return float(blobs.mean())


def _picture(evidence: ClipEvidence, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Frame `i` float32 [h,w,3] at no more than SIDE px, its gain taken off, and where it is surely not the person."""
    clip = evidence.clip
    image, gain = clip.images(i), evidence.gains[i]
    shrink = min(1.0, SIDE / max(image.shape))
    size = round(clip.width * shrink), round(clip.height * shrink)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    free = cv2.resize(background_mask(clip.mask(i)).astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
    return cv2.GaussianBlur(small, (0, 0), 0.7) * np.exp(-gain if np.isfinite(gain) else 0.0), free


def _warp_neighbour(evidence: ClipEvidence, i: int, j: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Frame `j` warped onto frame `i` by the motion of the tracks between them, and where it is known."""
    pixels, clip = evidence.tracks.pixels, evidence.clip
    both = np.isfinite(pixels[i, :, 0]) & np.isfinite(pixels[j, :, 0])
    if both.sum() < 20:
        return None
    picture, free = _picture(evidence, j)
    height, width = free.shape
    scale = width / clip.width
    at, there = pixels[i, both] * scale, pixels[j, both] * scale
    rows, columns = np.arange(0, height + GRID, GRID), np.arange(0, width + GRID, GRID)
    grid = np.stack(np.meshgrid(columns, rows), -1).astype(float)
    inner, outer = LinearNDInterpolator(at, there - at)(grid), NearestNDInterpolator(at, there - at)(grid)
    flow = np.where(np.isfinite(inner), inner, outer).astype(np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    flow = cv2.remap(flow, (x + 0.5) / GRID, (y + 0.5) / GRID, cv2.INTER_LINEAR)
    x, y = x + flow[..., 0], y + flow[..., 1]
    edge = NEAR // 2 + 1
    inside = (x > edge) & (x < width - 1 - edge) & (y > edge) & (y < height - 1 - edge)
    valid = cv2.remap(free.astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.99
    return cv2.remap(picture, x, y, cv2.INTER_LINEAR), inside & valid

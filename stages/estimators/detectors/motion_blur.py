"""Motion blur: are edges that lie across the motion wider than those that lie along it?"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.estimators.detectors.pictures import background_mask, sample

BLUR_PX = 0.9  # as measured: about half the length of a box blur, since edges are soft already
SHARE = 0.2  # of the frames that must be blurred by as much
UNIT = "px on a fifth of the frames"
REACH = 10  # px on either side of an edge in which its foot and top are looked for
EDGES, LEAST = 1500, 40  # of each kind, looked at in a frame and needed
SLOWEST = 0.5  # px a frame: slower has no sure direction
ALONG, ACROSS = 0.85, 0.35  # |cosine| of an edge's normal and the motion
SHARPEST = 0.25  # quantile of the widths: what is soft by itself says nothing


def detect(evidence: ClipEvidence) -> Finding:
    """The length of the blur that 20 % of the frames exceed, from the widths of the background's sharpest edges."""
    if evidence.facts.verdict == "static camera":
        return unmeasured(UNIT, BLUR_PX, "the camera stands still")
    clip, blurs = evidence.clip, np.full(len(evidence.clip.names), np.nan)
    for i in evidence.sampled:
        places, flow = motion_at(evidence.tracks.pixels, i)
        if len(places) >= 20:
            blurs[i] = blur_length(clip.images(i), background_mask(clip.mask(i)), places, flow)
    known = blurs[np.isfinite(blurs)]
    if len(known) < 4:
        return unmeasured(UNIT, BLUR_PX, "too few edges or followed points")
    value = np.quantile(known, 1 - SHARE)
    return compare(value, UNIT, BLUR_PX, ("blurred", "sharp"), strongest_frames(clip.names, blurs))


def motion_at(pixels: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Where followed points are in frame `i` [N,2] and how they move there [N,2] px a frame; `pixels` [F,T,2]."""
    before, after = max(i - 1, 0), min(i + 1, len(pixels) - 1)
    flow = (pixels[after] - pixels[before]) / max(after - before, 1)
    known = np.isfinite(flow).all(1) & np.isfinite(pixels[i]).all(1)
    return pixels[i][known], flow[known]


def blur_length(image: np.ndarray, allowed: np.ndarray, places: np.ndarray, flow: np.ndarray) -> float:
    """How much wider (in quadrature) edges across the motion are than edges along it, px; NaN if there are too few."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    gx, gy = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125)
    at, normal = _edges(gx, gy, allowed)
    moving = flow[cKDTree(places).query(at + 0.5)[1]]
    speed = np.linalg.norm(moving, axis=1)
    cosine = np.abs((normal * moving).sum(1)) / np.maximum(speed, 1e-6)
    sharpest = []
    for kind in (cosine > ALONG, cosine < ACROSS):  # each by itself: blurred edges are weaker
        chosen = np.flatnonzero(kind & (speed > SLOWEST))[:EDGES]
        widths = _widths(grey, at[chosen], normal[chosen])
        if np.isfinite(widths).sum() < LEAST:
            return np.nan
        sharpest.append(np.nanquantile(widths, SHARPEST))
    wide, narrow = sharpest
    return float(np.sqrt(max(wide**2 - narrow**2, 0)))


def _edges(gx: np.ndarray, gy: np.ndarray, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [N,2] where the slope is steepest along its own direction, and that direction [N,2]; strongest first."""
    size = np.hypot(gx, gy)
    inner = np.zeros_like(allowed)
    inner[REACH + 2 : -REACH - 2, REACH + 2 : -REACH - 2] = True
    rows, columns = np.nonzero(allowed & inner & (size > 6))
    at = np.stack([columns, rows], 1).astype(np.float32)
    normal = np.stack([gx[rows, columns], gy[rows, columns]], 1) / size[rows, columns][:, None]
    beside = [sample(size, at + 0.5 + sign * normal) for sign in (1, -1)]
    peak = (size[rows, columns] >= beside[0]) & (size[rows, columns] > beside[1])
    order = np.argsort(-size[rows, columns][peak], kind="stable")
    return at[peak][order], normal[peak][order]


def _widths(grey: np.ndarray, at: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Rise of each edge from foot to top over its steepest slope, in px [N]; NaN where it rises too little."""
    steps = np.arange(-REACH, REACH + 1, dtype=np.float32)
    profile = np.stack([sample(grey, at + 0.5 + t * normal) for t in steps], 1)
    rise = np.diff(profile, axis=1)
    upwards = np.cumprod(rise[:, REACH:] > 0, axis=1), np.cumprod(rise[:, REACH - 1 :: -1] > 0, axis=1)
    total = (rise[:, REACH:] * upwards[0]).sum(1) + (rise[:, REACH - 1 :: -1] * upwards[1]).sum(1)
    return np.where(total > 20, total / np.maximum(rise[:, REACH - 2 : REACH + 2].max(1), 1e-6), np.nan)

"""View-dependent colour: do points change their brightness with the direction they are seen from?"""

from __future__ import annotations

import numpy as np

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.estimators.detectors.pictures import brightness, sample
from stages.estimators.detectors.tracks import bearings

CHANGE = 6.0  # of 255: standard deviation over views
LIKENESS = 0.7  # least correlation of brightness and angle
SHARE = 0.1  # of the points that must change by as much
LEAST, ANGLE = 8, np.radians(3)  # frames and rad over which a point must be seen
UNIT = "of 255, std over views of a tenth of the points"


def detect(evidence: ClipEvidence) -> Finding:
    """How much the brightness of the most changing tenth of the points follows the view, gains taken off."""
    if not evidence.moving:
        return unmeasured(UNIT, CHANGE, "the camera does not move")
    clip, tracks = evidence.clip, evidence.tracks
    used = (tracks.lengths >= LEAST) & (tracks.angles > ANGLE)
    if used.sum() < 50:
        return unmeasured(UNIT, CHANGE, "too few points are seen from different sides")
    pixels = tracks.pixels[:, used]
    change = changes(pixels, greys_at(evidence, pixels), clip.viewmats, clip.Ks)
    seen = np.isfinite(pixels[..., 0])
    strong = change >= np.quantile(change, 1 - SHARE)
    return compare(np.quantile(change, 1 - SHARE), UNIT, CHANGE, ("glossy", "dull"),
                 strongest_frames(clip.names, (seen & strong).sum(1).astype(float)))  # fmt: skip


def greys_at(evidence: ClipEvidence, pixels: np.ndarray) -> np.ndarray:
    """Brightness [F,T] 0..255 at `pixels` [F,T,2], the gain of each frame taken off; NaN where unseen or clipped."""
    found = np.full(pixels.shape[:2], np.nan)
    for i, places in enumerate(pixels):
        seen = np.isfinite(places[:, 0])
        if seen.any():
            value = sample(brightness(evidence.clip.images(i)), places[seen])
            gain = evidence.gains[i] if np.isfinite(evidence.gains[i]) else 0.0
            found[i, seen] = np.where((value > 8) & (value < 247), value * np.exp(-gain), np.nan)
    return found


def changes(pixels: np.ndarray, greys: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """Standard deviation [T] of the part of `greys` [F,T] that is linear in the view direction; 0 where little is."""
    known = np.isfinite(greys) & np.isfinite(pixels[..., 0])
    rays = np.where(known[..., None], bearings(pixels, viewmats, Ks), 0)
    count = np.maximum(known.sum(0), 1)
    rays = np.where(known[..., None], rays - rays.sum(0) / count[:, None], 0)
    main = np.linalg.eigh(np.einsum("fti,ftj->tij", rays, rays))[1][..., -1]
    angle = np.einsum("fti,ti->ft", rays, main)
    values = np.where(known, greys, 0)
    values = np.where(known, values - values.sum(0) / count, 0)
    std = np.sqrt((values**2).sum(0) / count)
    likeness = np.abs((angle * values).sum(0)) / np.sqrt((angle**2).sum(0) * (values**2).sum(0) + 1e-9)
    return np.where((likeness > LIKENESS) & (known.sum(0) >= LEAST), std * likeness, 0.0)

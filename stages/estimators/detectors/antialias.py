"""Anti-aliasing: are things seen at very different sizes, so that what is sharp near by flickers far away?"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stages.avatar.cameras.pinhole import project
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.formats.clip import Clip

RATIO = 1.6  # of the largest and smallest scale at which the median point is seen
LEAST = 5  # frames that must see a point
UNIT = "times larger at its largest"


def detect(evidence: ClipEvidence) -> Finding:
    """Largest over smallest scale (focal length over depth) of the median point, and of the person if that is more."""
    clip, every = evidence.clip, range(len(evidence.clip.names))
    middles = evidence.bodies.mean(1)[:, None]
    things = [
        (clip.names, _scales(clip, every, [clip.points] * len(every))),
        ([clip.names[i] for i in evidence.sampled], _scales(clip, evidence.sampled, middles)),
    ]
    found = []
    for names, seen in things:
        seen = seen[:, np.isfinite(seen).sum(0) >= LEAST]
        if seen.size:
            sizes = seen / np.nanmedian(seen, 0)
            by_frame = [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in sizes]
            ratio = float(np.median(np.nanmax(seen, 0) / np.nanmin(seen, 0)))
            found.append((ratio, strongest_frames(tuple(names), np.array(by_frame))))
    if not found:
        return unmeasured(UNIT, RATIO, "nothing is seen often enough")
    ratio, frames = max(found, key=lambda one: one[0])
    return compare(ratio, UNIT, RATIO, ("sizes differ", "one size"), frames)


def _scales(clip: Clip, rows: Iterable[int], places: Iterable[np.ndarray]) -> np.ndarray:
    """Px per metre [R,P] at which frame `rows` [R] of the clip see `places` [R,P,3] of them; NaN where they do not."""
    found = []
    for i, points in zip(rows, places, strict=True):
        pixels, z = project(points, clip.viewmats[i], clip.Ks[i])
        inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [clip.width, clip.height]).all(1)
        found.append(np.where(inside, clip.Ks[i, 0, 0] / np.where(inside, z, 1), np.nan))
    return np.array(found)

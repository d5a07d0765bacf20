"""Anti-aliasing: are things seen at very different sizes, so that what is sharp near by flickers far away?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.avatar.cameras.pinhole import project
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

if TYPE_CHECKING:
    from stages.estimators.detectors.evidence import ClipEvidence

RATIO = 1.6  # of the largest and smallest scale at which the median point is seen
LEAST = 5  # frames that must see a point
UNIT = "times larger at its largest"


def detect(evidence: ClipEvidence) -> Finding:
    """Largest over smallest scale (focal length over depth) of the median point, and of the person if that is more."""
    clip = evidence.clip
    things = [clip.points, evidence.bodies.mean((0, 1))[None]]
    ratios, frames = [], []
    for points in things:
        seen = np.full((len(clip.names), len(points)), np.nan)
        for i in range(len(clip.names) if len(points) else 0):
            pixels, z = project(points, clip.viewmats[i], clip.Ks[i])
            inside = (z > 0) & (pixels >= 0).all(1) & (pixels < [clip.width, clip.height]).all(1)
            seen[i, inside] = clip.Ks[i, 0, 0] / z[inside]
        known = np.isfinite(seen).sum(0) >= LEAST
        if known.any():
            seen = seen[:, known]
            ratios.append(float(np.median(np.nanmax(seen, 0) / np.nanmin(seen, 0))))
            sizes = seen / np.nanmedian(seen, 0)
            frames.append([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in sizes])
    if not ratios:
        return unmeasured(UNIT, RATIO, "nothing is seen often enough")
    most = int(np.argmax(ratios))
    return compare(
        ratios[most], UNIT, RATIO, ("sizes differ", "one size"), strongest_frames(clip.names, np.array(frames[most]))
    )

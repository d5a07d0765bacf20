"""Clothing that leaves the body: does the outline stand off the body by more in some poses than in others?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

if TYPE_CHECKING:
    from stages.estimators.detectors.evidence import ClipEvidence

SWING = 0.03  # between poses, of the body's area
OUTWARDS = 3.0  # the mask must miss so many times less of the body than it adds; a wrong pose does both
LEAST = 8  # frames with a person
UNIT = "of the body's area, between poses"


def detect(evidence: ClipEvidence) -> Finding:
    """How the area of the mask outside the posed body varies: its 90 % quantile over frames less that of 10 %."""
    clip = evidence.clip
    outside, missed = np.full((2, len(clip.names)), np.nan)
    for i, drawn in zip(evidence.sampled, evidence.outlines):
        mask = clip.mask(i) > 127
        if mask.any() and drawn.any() and clip.body.confidence[i] > 0:
            outside[i], missed[i] = (mask & ~drawn).sum() / drawn.sum(), (drawn & ~mask).sum() / drawn.sum()
    if np.isfinite(outside).sum() < LEAST:
        return unmeasured(UNIT, SWING, "the person is seen in too few frames")
    swing = np.subtract(*np.nanquantile(outside - missed, [0.9, 0.1]))
    only = np.nanmedian(outside) > OUTWARDS * np.nanmedian(missed)
    return compare(
        swing, UNIT, SWING, ("swings", "stays with the body"), strongest_frames(clip.names, outside - missed), only
    )

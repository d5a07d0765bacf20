"""Clothing that leaves the body: does the outline stand off the body by more in some poses than in others?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

if TYPE_CHECKING:
    from stages.estimators.detectors.evidence import ClipEvidence

SWING = 0.03  # between poses, of the body's area
# Of bare bodies with our own fit: 0.02 to 0.21 on twelve synthetic clips to set limits, 0.13 or less on nine; with true
# poses 0.000. A skirt 20 cm wide swings by 0.12. So with our own fit only what is wider still can be told from its errors.
SWING_OF_FIT = 0.15
OUTWARDS = 3.0  # the mask must miss so many times less of the body than it adds; a wrong pose does both
LEAST = 8  # frames with a person
UNIT = "of the body's area, between poses"


def detect(evidence: ClipEvidence) -> Finding:
    """How the mask's area off the posed body, less what it misses, varies: 90 % quantile of frames less 10 %.

    Poses that we fitted ourselves err, so their swing must exceed a higher limit.
    """
    clip, limit = evidence.clip, SWING_OF_FIT if evidence.fitted else SWING
    outside, missed = np.full((2, len(clip.names)), np.nan)
    for i, drawn in zip(evidence.sampled, evidence.outlines):
        mask = clip.mask(i) > 127
        if mask.any() and drawn.any() and clip.body.confidence[i] > 0:
            outside[i], missed[i] = (mask & ~drawn).sum() / drawn.sum(), (drawn & ~mask).sum() / drawn.sum()
    if np.isfinite(outside).sum() < LEAST:
        return unmeasured(UNIT, limit, "the person is seen in too few frames")
    swing = np.subtract(*np.nanquantile(outside - missed, [0.9, 0.1]))
    only = np.nanmedian(outside) > OUTWARDS * np.nanmedian(missed)
    rest = "cannot be told from errors of our body fit" if evidence.fitted and swing > SWING else "stays with the body"
    return compare(swing, UNIT, limit, ("swings", rest), strongest_frames(clip.names, outside - missed), only)

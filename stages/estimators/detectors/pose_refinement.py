"""Body-pose error: does the posed body cover the person?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.estimators.detectors.finding import Finding, above, strongest, unknown

if TYPE_CHECKING:
    from stages.estimators.detectors.evidence import Evidence

GAP = 0.05  # clothes and hair alone cost 0.05 to 0.1, a wrong pose more; refining is cheap
UNIT = "of body and mask not shared"


def detect(evidence: Evidence) -> Finding:
    """1 - IoU of posed body and mask, the median over frames."""
    clip, gaps = evidence.clip, np.full(len(evidence.clip.names), np.nan)
    for i, drawn in zip(evidence.some, evidence.outlines):
        mask = clip.mask(i) > 127
        if mask.any() and clip.body.confidence[i] > 0:
            gaps[i] = 1 - overlap(drawn, mask)
    if np.isnan(gaps).all():
        return unknown(UNIT, GAP, "nobody is seen")
    return above(np.nanmedian(gaps), UNIT, GAP, ("loose", "good"), strongest(clip.names, gaps))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boolean masks, 0 if both are empty."""
    return float((a & b).sum() / max((a | b).sum(), 1))

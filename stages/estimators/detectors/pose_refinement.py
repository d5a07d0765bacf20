"""Body-pose error: does the posed body cover the person?"""

from __future__ import annotations

import cv2
import numpy as np

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

GAP = 0.001  # true poses: 0.0000; a fit of ours to true masks, 4 cm off along the view: 0.003; clothes: 0.07
UNIT = "of body and mask more than a pixel apart"
NEAR = np.ones((3, 3), np.uint8)


def detect(evidence: ClipEvidence) -> Finding:
    """The median over frames of the share in which posed body and mask differ.

    A fit made from outlines agrees with them and errs along the view, so a small gap is enough: refining is cheap.
    """
    clip, gaps = evidence.clip, np.full(len(evidence.clip.names), np.nan)
    for i, drawn in zip(evidence.sampled, evidence.outlines):
        mask = clip.mask(i) > 127
        if mask.any() and clip.body.confidence[i] > 0:
            gaps[i] = share_apart(drawn, mask)
    if np.isnan(gaps).all():
        return unmeasured(UNIT, GAP, "nobody is seen")
    return compare(np.nanmedian(gaps), UNIT, GAP, ("loose", "good"), strongest_frames(clip.names, gaps))


def share_apart(a: np.ndarray, b: np.ndarray) -> float:
    """Share of the union of two boolean masks that is in one and does not touch the other; 0 if both are empty.

    An edge is known to a pixel: of small people that alone is 3 % of their area, which is not counted.
    """
    near_a, near_b = (cv2.dilate(mask.astype(np.uint8), NEAR) > 0 for mask in (a, b))
    return float(((a & ~near_b).sum() + (b & ~near_a).sum()) / max((a | b).sum(), 1))

"""Camera-pose error: do the cameras contradict what is seen in several frames?"""

from __future__ import annotations

import numpy as np

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

ERROR_PX = 1.0
UNIT = "px that other poses would mend"


def detect(evidence: ClipEvidence) -> Finding:
    """By how much the tracks' errors shrink when each camera may move, in px over the clip."""
    left = evidence.residuals
    if left is None:
        return unmeasured(UNIT, ERROR_PX, "too few points could be placed")
    value = np.sqrt(np.median(left.mended_px**2))
    return compare(value, UNIT, ERROR_PX, ("off", "good"), strongest_frames(evidence.clip.names, left.mended_px))

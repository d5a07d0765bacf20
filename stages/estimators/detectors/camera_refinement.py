"""Camera-pose error: do the cameras contradict what is seen in several frames?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stages.estimators.detectors.finding import Finding, above, strongest, unknown

if TYPE_CHECKING:
    from stages.estimators.detectors.evidence import Evidence

ERROR_PX = 1.0
UNIT = "px that other poses would mend"


def detect(evidence: Evidence) -> Finding:
    """By how much the tracks' errors shrink when each camera may move, in px over the clip."""
    left = evidence.leftover
    if left is None:
        return unknown(UNIT, ERROR_PX, "too few points could be placed")
    value = np.sqrt(np.median(left.mended_px**2))
    return above(value, UNIT, ERROR_PX, ("off", "good"), strongest(evidence.clip.names, left.mended_px))

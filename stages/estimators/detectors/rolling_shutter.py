"""Rolling shutter: do points move within a picture as if its rows were read one after the other?"""

from __future__ import annotations

import numpy as np

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

SHIFT_PX = 0.5  # of the first and last row against the middle one
SIGMAS = 3.0
FAST = 0.8  # quantile of the frames by speed: where the camera moves is where it shows
UNIT = "px at the first and last row"


def detect(evidence: ClipEvidence) -> Finding:
    """How far the first and last rows of the faster frames are moved, from the readout time that fits all tracks best."""
    left = evidence.residuals
    if left is None:
        return unmeasured(UNIT, SHIFT_PX, "too few points could be placed")
    shift = abs(left.readout) / 2 * np.quantile(left.speed_px, FAST)
    sure = abs(left.readout) > SIGMAS * left.readout_std
    return compare(
        shift, UNIT, SHIFT_PX, ("rolls", "does not show"), strongest_frames(evidence.clip.names, left.speed_px), sure
    )

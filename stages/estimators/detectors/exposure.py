"""Exposure and white balance: does the background's brightness, or its tint, drift or jump?"""

from __future__ import annotations

import numpy as np

from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured

STD, STEP = 0.02, 0.05
"""Of the log gain, of all light or of red or blue beside green: over the clip, and between neighbouring frames."""
UNIT = "std of the log gain"


def detect(evidence: ClipEvidence) -> Finding:
    """The standard deviation of the log gain or of a tint; a single jump of more than STEP calls for it too."""
    light = evidence.light.T
    if np.isfinite(light[0]).sum() < 3:
        return unmeasured(UNIT, STD, "too few points of the background")
    drifts = [_drift(series) for series in light]
    most = int(np.argmax(drifts))
    words = ("changes tint" if most else "drifts", "steady")
    return compare(drifts[most], UNIT, STD, words, strongest_frames(evidence.clip.names, np.abs(light[most])))


def _drift(series: np.ndarray) -> float:
    """Standard deviation of log gains [F], NaN left out; or the largest jump x STD / STEP, if more."""
    seen = series[np.isfinite(series)]
    return max(seen.std(), np.abs(np.diff(seen)).max() * STD / STEP) if len(seen) > 1 else 0.0

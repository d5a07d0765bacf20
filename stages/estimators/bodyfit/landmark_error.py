"""How far a network's landmarks are off, as their own jitter over time and the person's outline show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.estimators.bodyfit.solve import LANDMARK

SURE, LEAST = 0.5, 8  # weight, and frames with both, of a landmark that is measured
AROUND = (
    np.array([-1, 4, 4, -1]) / 6
)  # of two frames before and after: what a motion of even change makes of the one between
GAIN = np.sqrt(1 + (AROUND**2).sum())  # how much larger the difference is than one landmark's error
FARTHEST = 0.1  # of the height, so that one stray does not count as many
REST = 0.25  # of the square of LANDMARK, that is the body's at least


def measured_errors(evidence: LandmarkEvidence, masks: Sequence[np.ndarray]) -> np.ndarray:
    """Error [K] of each landmark as a share of the person's height, NaN where too few frames show it.

    Over time: the median distance from the curve through the frames around it, as of a normal spread. By outlines: the root
    mean square of how far it lies outside the mask uint8 [H,W]; that inside nothing is known shows no error.
    """
    sure = (evidence.weight > SURE) & evidence.seen[:, None]
    size = evidence.height[:, None]
    errors = np.full(len(evidence.names), np.nan)
    outside = np.full(sure.shape, np.nan)
    for i, mask in enumerate(masks):
        if evidence.seen[i] and (mask > 127).any():
            away = cv2.distanceTransform((mask <= 127).astype(np.uint8), cv2.DIST_L2, 5)
            rows, columns = mask.shape
            at = np.floor(evidence.xy[i]).astype(int).clip(0, [columns - 1, rows - 1])
            outside[i] = np.minimum(away[at[:, 1], at[:, 0]] / evidence.height[i], FARTHEST)
    middle = sum(share * np.roll(evidence.xy, -step, 0) for share, step in zip(AROUND, (-2, -1, 1, 2)))
    jitter = np.linalg.norm(evidence.xy - middle, axis=-1) / size / GAIN
    whole = np.logical_and.reduce([np.roll(sure, step, 0) for step in (-2, -1, 0, 1, 2)])
    whole[:2] = whole[-2:] = False
    for k in range(len(evidence.names)):
        over, out = jitter[whole[:, k], k], outside[sure[:, k], k]
        out = out[np.isfinite(out)]
        if len(over) >= LEAST and len(out) >= LEAST:
            errors[k] = np.hypot(np.median(over) / 1.177 * np.sqrt(2), np.sqrt((out**2).mean()))
    return errors


def weighed(
    evidence: LandmarkEvidence, blazepose: LandmarkEvidence, masks: Sequence[np.ndarray]
) -> tuple[LandmarkEvidence, str]:
    """The evidence with trust in each landmark by its error against that of BlazePose's, measured alike, and both in words.

    Of LANDMARK, by which the fit takes BlazePose's to be off, what is measured is BlazePose's own; the rest is how far the body
    is from anybody's landmarks, and stays. One that too few frames show is trusted as the median one.
    """
    errors, theirs = measured_errors(evidence, masks), measured_errors(blazepose, masks)
    if np.isnan(errors).all() or np.isnan(theirs).all():
        return evidence, "an error that too few frames show: trusted as BlazePose's"
    middle, known = np.nanmedian(errors), np.nanmedian(theirs)
    rest = max(LANDMARK**2 - known**2, REST * LANDMARK**2)
    trust = LANDMARK**2 / (rest + np.where(np.isnan(errors), middle, errors) ** 2)
    words = f"{100 * middle:.2f} % of the person's height over time and by outlines, BlazePose's {100 * known:.2f} %"
    return replace(evidence, trust=trust), words

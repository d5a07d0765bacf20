"""Whether given masks lie where something moves, before the motion of the whole picture: masks of other frames do not."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from stages.estimators.corners import Choice, follow_pair
from stages.formats.images import evenly

PAIRS = 10  # of frames that are compared
SIDE = 240  # px of the longer side, at which they are
CORNERS = Choice(most=200, apart=4, quality=0.01, returns=1.0)
LEAST = 10.0  # grey levels by which one pixel in 200 differs, for something to move
ELSEWHERE = 0.4  # of what the mask would cover by its area alone: so little of what moves lies in masks of other frames
NEARLY_ALL = 0.8  # of the pairs


def lies_elsewhere(count: int, image: Callable[[int], np.ndarray], mask: Callable[[int], np.ndarray]) -> bool:
    """Whether in nearly all pairs of neighbouring frames what moves otherwise than the picture lies beside the masks.

    `image` gives the i-th of `count` frames uint8 [H,W,3], `mask` its mask uint8 [H,W]. False where too little moves to tell.
    """
    first = evenly(count - 1, PAIRS) if count > 1 else []
    shares = (_share(image(i), image(i + 1), mask(i), mask(i + 1)) for i in first)
    found = [share for share in shares if share is not None]
    return len(found) >= PAIRS // 2 and float(np.mean(np.array(found) < ELSEWHERE)) >= NEARLY_ALL


def _share(one: np.ndarray, two: np.ndarray, mask: np.ndarray, other: np.ndarray) -> float | None:
    """Share of the motion that lies in either mask, over the masks' share of the picture; None where nothing tells."""
    scale = SIDE / max(one.shape)
    size = (max(round(one.shape[1] * scale), 8), max(round(one.shape[0] * scale), 8))
    grey = [
        cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY) for image in (one, two)
    ]
    covered = cv2.resize(np.maximum(mask, other), size, interpolation=cv2.INTER_AREA) > 127
    everywhere = np.ones_like(covered)
    before, after = follow_pair((grey[0], everywhere), (grey[1], everywhere), CORNERS)
    again = np.isfinite(after[:, 0])
    way = cv2.estimateAffine2D(before[again], after[again])[0] if again.sum() >= 8 else None
    moved = cv2.warpAffine(grey[0], np.eye(2, 3) if way is None else way, size, borderMode=cv2.BORDER_REPLICATE)
    change = cv2.GaussianBlur(abs(moved.astype(np.float32) - grey[1]), (0, 0), 2)
    change = np.maximum(change - 2 * np.median(change), 0)
    if not covered.any() or np.percentile(change, 99.5) < LEAST or covered.mean() > 0.5:
        return None
    return float(change[covered].sum() / change.sum() / covered.mean())

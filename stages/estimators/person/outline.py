"""The outline of the person whom BlazePose follows: the mean of several looks, close looks at both halves, edges by colour."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from stages.estimators.person.blazepose import CROP_SIDE, SURE, BlazePose, Images, sigmoid
from stages.estimators.person.crops import Roi

# Looks at the whole person: (side as a share of the fitting crop, turn in degrees), each also at the mirrored picture.
# Measured on ten frames of the synthetic clip: IoU 0.88 from one look, 0.904 from these six.
WHOLE = ((1.0, 0), (0.9, 8), (0.9, -8))
# Closer looks at the upper and the lower half: (side, turn in degrees, shift along the body), as shares of the crop.
HALVES = tuple((0.65, turn, shift) for shift in (-0.2, 0.2) for turn in (0, 8, -8))
BAND = 2  # px of the whole person's mask: closer looks only move an edge that far
CLOSE_SHARE = 0.5  # their weight there; alone they err at the halves' ends (IoU 0.903, with both 0.907)
FADE = 0.12  # share of a close look's side over which it fades out towards its rim
GUIDE_RADIUS = 1.5  # px of the whole person's mask over which edges are set by colour
GUIDE_EPS = 2e-4 * 255**2  # colour variance below which the guided filter (He et al. 2013) smooths a patch
ISLAND = 0.01  # a part smaller than this share of the person is no part of the person
STEEP = 2.0  # times as fast as the network's probability, about one half, grows what a pixel shows of the person
RIM = 0.01, 2.0  # of the person's height, and px at least: so far from the outline a pixel shows the person or not
WORKERS = 2  # pictures at a time, each on one thread: the same to the bit as one picture on two, and 2 s of 14 less
AHEAD = 8  # pictures whose outlines wait for their turn


def outlines(images: Images, crops: Sequence[Sequence[Roi | None]]) -> Iterator[list[np.ndarray]]:
    """The `outline` in each of the crops of each picture, in order; nothing but 0 where there is no crop."""
    own = threading.local()

    def there(i: int) -> list[np.ndarray]:
        if not hasattr(own, "network"):
            own.network = BlazePose(threads=1)
        image = images[i]
        blank = np.zeros(image.shape[:2], np.float32)
        return [blank if roi is None else outline(own.network, image, roi) for roi in crops[i]]

    with ThreadPoolExecutor(WORKERS) as pool:
        for first in range(0, len(crops), AHEAD):
            yield from pool.map(there, range(first, min(first + AHEAD, len(crops))))


def outline(network: BlazePose, image: np.ndarray, roi: Roi) -> np.ndarray:
    """Probability [H,W] float32 that a pixel of the image uint8 [H,W,3] shows the person of the crop `roi`."""
    whole = np.zeros(image.shape[:2], np.float32)
    mirror = np.ascontiguousarray(image[:, ::-1])
    for side, turn in WHOLE:
        part = roi.reframe(side, turn)
        mirrored = Roi(image.shape[1] - part.x, part.y, part.side, -part.angle)
        whole += look(network, image, part)[0] + look(network, mirror, mirrored)[0][:, ::-1]
    whole /= 2 * len(WHOLE)
    edge = near_edge(whole, BAND * roi.side / CROP_SIDE)
    close, weights = np.zeros_like(whole), np.zeros_like(whole)
    for side, turn, shift in HALVES:
        part = roi.reframe(side, turn, shift)
        mask, presence = look(network, image, part)
        if presence >= SURE:
            share = paste(rim_fade(), part, image.shape)
            close += mask * share
            weights += share
    trust = CLOSE_SHARE * edge * np.minimum(weights, 1)
    mixed = whole + trust * (close / np.maximum(weights, 1e-6) - whole)
    radius = max(round(GUIDE_RADIUS * roi.side / CROP_SIDE), 2)
    return without_islands(cv2.ximgproc.guidedFilter(image, mixed, radius, GUIDE_EPS).clip(0, 1))


def look(network: BlazePose, image: np.ndarray, roi: Roi) -> tuple[np.ndarray, float]:
    """The mask of one look, in the picture [H,W], and the probability that somebody is there."""
    pose, logits = network.look(image, roi)
    return paste(sigmoid(logits), roi, image.shape), pose.presence


def paste(mask: np.ndarray, roi: Roi, shape: tuple[int, ...]) -> np.ndarray:
    """Put a crop's mask [S,S] into a picture of this shape, zero outside the crop."""
    matrix = roi.matrix()
    matrix[:, :2] /= len(mask)
    matrix[:, 2] += matrix[:, :2].sum(1) / 2 - 0.5  # cv2 counts pixel centres at whole numbers
    return cv2.warpAffine(mask, matrix, (shape[1], shape[0]), flags=cv2.INTER_LINEAR)


def rim_fade() -> np.ndarray:
    """Weight [S,S] of a close look: 1 inside, falling to 0 at its rim, where the network guesses at a body that is cut off."""
    x = (np.arange(CROP_SIDE) + 0.5) / CROP_SIDE
    ramp = np.minimum(np.minimum(x, 1 - x) / FADE, 1).astype(np.float32)
    return np.minimum.outer(ramp, ramp)


def near_edge(mask: np.ndarray, distance: float) -> np.ndarray:
    """1 on the mask's outline, falling to 0 at this distance in px; float32 [H,W]."""
    inside = (mask > SURE).astype(np.uint8)
    far = cv2.distanceTransform(inside, cv2.DIST_L2, 3) + cv2.distanceTransform(1 - inside, cv2.DIST_L2, 3)
    return (2 - 2 * far / distance).clip(0, 1)


def without_islands(mask: np.ndarray) -> np.ndarray:
    """Set parts that do not touch the person, and are small, to zero."""
    solid = (mask > 0.1).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(solid)
    if count < 2:
        return mask
    areas = stats[1:, cv2.CC_STAT_AREA]
    small = 1 + np.flatnonzero(areas < ISLAND * areas.max())
    return np.where(np.isin(labels, small), 0, mask)


def coverage(mask: np.ndarray) -> np.ndarray:
    """How much of each pixel the person covers, uint8 [H,W], by the probability `mask` uint8 [H,W], 255 = 1, that it shows them.

    A network that is 70 % sure of a pixel of the chest does not say that one sees through the chest.
    """
    sure = mask / np.float32(255)
    inside = (mask > 127).astype(np.uint8)
    rows = np.flatnonzero(inside.any(1))
    if len(rows) == 0:
        return np.zeros_like(mask)
    rim = max(RIM[0] * (np.ptp(rows) + 1), RIM[1])
    deep, far = ((cv2.distanceTransform(part, cv2.DIST_L2, 5) / rim - 1).clip(0, 1) for part in (inside, 1 - inside))
    share = (STEEP * (sure - 0.5) + 0.5).clip(0, 1)
    return np.rint(255 * np.where(inside > 0, np.maximum(share, deep), np.minimum(share, 1 - far))).astype(np.uint8)

"""What the static scene explains is not the person: the outlines of masks, seen again in the light of the other frames.

Each frame is compared with the same piece of the scene in other frames, where the person does not hide it: found by how
the scene moves around the person, brought on the pixel by optical flow, and looked up within a pixel. Where they agree there
is background, where nothing agrees there is somebody.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from stages.estimators.person.blazepose import Images
from stages.estimators.person.scene_motion import HIDDEN, SceneMotion, disk

GAPS = (2, 4, 7, 11, 16, 22, 28)  # frames before and after that a frame is compared with
GONE = 5  # frames after somebody is seen, and before: in an empty mask within them they are rather missed than gone
AHEAD = 8  # frames whose masks wait for their turn
TALL = 240  # px: a person who is taller is compared in smaller pictures, in half of them with a fourth of the work
REACH = 0.05  # of the person's height, around the mask, in which pixels may change sides
RING = 0.20  # of the person's height, beyond, where the flow of the scene is measured
BLUR = 0.7  # px, of the difference of colours
FLOW_BLUR = 9.0, 30.0  # px, over which the scene's flow is carried on behind the person: the nearer where it is known
FLOW_MOST = 10.0  # px that the scene's motion may be off
WORTH = 0.05  # share of the pixels in question that another frame must show
DIFFERENT = 5.0  # times the difference that background shows, from which on a pixel is rather the person
USUAL_LEAST = 4.0  # of that difference, summed over the three colours of 0..255
SLOPE = 3.0  # log-odds for each factor of e
DETAIL = 0.6  # power of the scene's detail, by which a pixel may differ more: flow is never quite right
HALF, EDGE, SURE = 0.25, 2, 0.8  # of the difference within 2 px inside, where the mask is sure: an edge lies half-way
MOST = 3.0  # log-odds
DOUBT = 0.02  # of a mask's 0 and 255
ADD = np.ones((1, 3), np.float32)
GUIDE_RADIUS, GUIDE_EPS = 2, 2e-4 * 255**2


@dataclass(frozen=True)
class Window:
    """The part of a frame around its mask: rows and columns, and which of its pixels [h,w] are in question."""

    rows: slice
    columns: slice
    asked: np.ndarray


def corrected(masks: Sequence[np.ndarray], images: Images) -> Iterator[np.ndarray]:
    """The masks uint8 [H,W] of all frames, 255 = person, their edges moved to where the static scene ends."""
    rows = [np.flatnonzero((mask > 127).any(1)) for mask in masks]
    seen = np.array([len(one) > 0 for one in rows], bool)
    if not seen.any():
        yield from masks
        return
    scale = min(TALL / np.median([np.ptp(one) + 1 for one in rows if len(one)]), 1.0)
    lost = {i for i in np.flatnonzero(~seen) if seen[max(i - GONE, 0) : i + GONE + 1].any()}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        small = list(pool.map(lambda i: _resized(images[i], scale), range(len(images))))
        asked = list(pool.map(partial(_resized, scale=scale), masks))
        hidden = [cv2.dilate(mask, disk(2)) for mask in asked]
        motion = SceneMotion([cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in small], hidden)

        def one(frame: int) -> np.ndarray:
            window = _window(asked[frame])
            if window is None:
                return masks[frame]
            others = {frame + sign * gap for gap in GAPS for sign in (-1, 1)} & set(range(len(images)))
            evidence = _compared(frame, sorted(others - lost), asked[frame], window, hidden, small, motion)
            return masks[frame] if evidence is None else _decided(masks[frame], images[frame], evidence)

        for first in range(0, len(masks), AHEAD):
            yield from pool.map(one, range(first, min(first + AHEAD, len(masks))))


def with_outline(own: Sequence[np.ndarray], after: np.ndarray) -> list[np.ndarray]:
    """Each person's own mask uint8 [H,W] once everybody's together has become `after`: what is new is the nearest's."""
    if len(own) == 1:
        return [after]
    away = [cv2.distanceTransform((one < 128).astype(np.uint8), cv2.DIST_L2, 5) for one in own]
    nearest = np.argmin(away, 0)
    return [np.where(nearest == k, after, np.minimum(one, after)) for k, one in enumerate(own)]


def _resized(picture: np.ndarray, scale: float) -> np.ndarray:
    """The picture [H,W,...] at `scale`, by area; the same for 1."""
    if scale == 1:
        return picture
    height, width = (max(round(scale * side), 1) for side in picture.shape[:2])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def _window(mask: np.ndarray) -> Window | None:
    """None for an empty mask."""
    rows, columns = np.nonzero(mask > 127)
    if len(rows) == 0:
        return None
    tall = np.ptp(rows) + 1
    asked = cv2.dilate(mask, disk(max(REACH * tall, 3))) > 20
    rows, columns = np.nonzero(asked)
    ring = round(max(RING * tall, 20))
    height, width = mask.shape
    y = slice(max(rows.min() - ring, 0), min(rows.max() + ring, height))
    x = slice(max(columns.min() - ring, 0), min(columns.max() + ring, width))
    return Window(y, x, asked[y, x])


def _compared(
    frame: int,
    others: Sequence[int],
    mask: np.ndarray,
    window: Window,
    hidden: Sequence[np.ndarray],
    images: Sequence[np.ndarray],
    motion: SceneMotion,
) -> np.ndarray | None:
    """What `others` say of a frame's mask: log-odds [H,W] that a pixel is the person, NaN where it is not in question.

    Their own person hides what `hidden` [H,W] marks. None where nothing is known.
    """
    image = np.ascontiguousarray(images[frame][window.rows, window.columns])
    least = np.full(image.shape[:2], np.inf, np.float32)
    for other in others:
        places = motion.places(frame, other, window.rows, window.columns)
        if places is None:
            continue
        scene = cv2.remap(images[other], *places, cv2.INTER_LINEAR)
        theirs = cv2.remap(hidden[other], *places, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, 255)
        shown = theirs < HIDDEN
        if (shown & window.asked).sum() >= WORTH * window.asked.sum():
            gap = _difference(image, scene, shown & ~window.asked)
            least = np.where(shown, np.minimum(least, gap), least)
    return _evidence(mask, window, least)


def _difference(image: np.ndarray, scene: np.ndarray, known: np.ndarray) -> np.ndarray:
    """How far the colours of the image are from those of the warped scene, each pixel's best place within one pixel [h,w].

    `known` [h,w] is where both show the scene: there the flow is measured, and carried on from there behind the person.
    """
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    here, there = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (image, scene))
    flow = search.calc(here, there, np.zeros((*here.shape, 2), np.float32))
    known = known & (np.maximum(abs(flow[..., 0]), abs(flow[..., 1])) < FLOW_MOST)
    flow = np.where(known[..., None], flow, _behind(flow, known))
    height, width = known.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    moved = cv2.remap(scene, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    detail = cv2.blur(_detail(moved), (5, 5))
    mine, theirs = cv2.split(image), cv2.split(cv2.copyMakeBorder(moved, 1, 1, 1, 1, cv2.BORDER_REPLICATE))
    least = np.full(known.shape, np.inf, np.float32)
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            at = np.s_[down : down + height, right : right + width]
            red, green, blue = (cv2.absdiff(a, b[at]) for a, b in zip(mine, theirs, strict=True))
            apart = cv2.add(cv2.add(red, green, dtype=cv2.CV_16U), blue, dtype=cv2.CV_32F)
            least = np.minimum(least, cv2.GaussianBlur(apart, (0, 0), BLUR))
    usual = max(float(np.median(detail[known])), 1.0) if known.any() else 1.0
    return least / cv2.pow(np.maximum(detail / usual, 1), DETAIL)


def _behind(flow: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The flow [h,w,2] where it is `known` [h,w], carried on: the nearest, where some is near. At a quarter of the size."""
    height, width = known.shape
    size = max(width // 4, 1), max(height // 4, 1)
    there = known.astype(np.float32)
    parts = (flow[..., 0] * there, flow[..., 1] * there, there)
    small = np.dstack([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts])
    near, far = (cv2.GaussianBlur(small, (0, 0), sigma / 4) for sigma in FLOW_BLUR)
    share = (near[..., 2:] / 0.05).clip(0, 1)
    means = [mean[..., :2] / np.maximum(mean[..., 2:], 1e-4) for mean in (near, far)]
    carried = means[0] * share + means[1] * (1 - share)
    return cv2.resize(carried, (width, height), interpolation=cv2.INTER_LINEAR)


def _detail(image: np.ndarray) -> np.ndarray:
    """How much the colours of neighbouring pixels differ [h,w]: what flow that is a little off shows as a difference."""
    brush = np.ones((3, 3), np.uint8)
    spread = cv2.subtract(cv2.dilate(image, brush), cv2.erode(image, brush))
    return cv2.transform(spread.astype(np.float32), ADD)


def _evidence(mask: np.ndarray, window: Window, gap: np.ndarray) -> np.ndarray | None:
    """`_compared` of `gap` [h,w], infinite where nothing is known."""
    known = np.isfinite(gap)
    usual = gap[known & ~window.asked]
    if len(usual) == 0:
        return None
    before = mask[window.rows, window.columns] / np.float32(255)
    least = max(float(np.median(usual)), USUAL_LEAST)
    inside = cv2.dilate(np.where(known & (before > SURE), gap, 0).astype(np.float32), disk(EDGE))
    limit = np.maximum(DIFFERENT * least, HALF * inside)
    ratio = np.where(known, np.maximum(gap, 1e-3) / limit, 1)
    found = np.full(mask.shape, np.nan, np.float32)
    odds = (SLOPE * np.log(ratio)).clip(-MOST, MOST)
    found[window.rows, window.columns] = np.where(window.asked, odds, np.nan)
    return found


def _decided(mask: np.ndarray, image: np.ndarray, evidence: np.ndarray) -> np.ndarray:
    """The mask [H,W] with the `evidence` of a smaller picture or one of its size [h,w]; its edges follow the image's."""
    height, width = mask.shape
    asked = np.isfinite(evidence)
    if evidence.shape != mask.shape:
        evidence = cv2.resize(np.where(asked, evidence, 0), (width, height), interpolation=cv2.INTER_LINEAR)
        asked = cv2.resize(asked.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    reach = 2 * GUIDE_RADIUS + 1
    (top, bottom), (left, right) = (np.flatnonzero(asked.any(axis))[[0, -1]] for axis in (1, 0))
    window = np.s_[max(top - reach, 0) : bottom + reach + 1, max(left - reach, 0) : right + reach + 1]
    before = mask[window] / np.float32(255)
    odds = np.log((before + DOUBT) / (1 + DOUBT - before)) + evidence[window]
    person = np.where(asked[window], 1 / (1 + np.exp(-odds)), before).astype(np.float32)
    person = cv2.ximgproc.guidedFilter(np.ascontiguousarray(image[window]), person, GUIDE_RADIUS, GUIDE_EPS).clip(0, 1)
    result = mask.copy()
    result[window] = np.rint(255 * person)
    return result

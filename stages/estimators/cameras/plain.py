"""Whether the camera stands before a plain background: pixels of edges, also soft ones, that do not change.

A floor line, a door or a blurred wall has no corners, but its pixels change as soon as it moves: by its slope times the way.
Brighter and darker pictures are made alike first, and the person with its rim is left out.
Source: normal flow, Horn and Schunck 1981, over the whole clip in place of two frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from stages.estimators.cameras.motion import STATIC_PX
from stages.estimators.cameras.stillness import CELLS, COVERED, FEW, LOOKED_AT, MOST, SOME, STAYS
from stages.formats.images import evenly, read_image, read_mask

SIDE = 480  # px: the pictures' longer side, as they are compared
BLUR, SOFT = 2.0, 8.0  # px of it: noise is averaged away; what moves by the limit moves by less. SOFT: light on a wall
EXISTS = 1.0  # of 255: a change by less may be the compression's
NOISE = 2.0  # times the noise: a change by less may be noise
BLACK = 20  # of 255: what is never brighter may be a bar of a wider film; its rim stays in place
REACH = np.ones((2 * round(2 * BLUR) + 1,) * 2, np.uint8)  # of a smoothed pixel
HALF = 0.5  # of the frames must see a pixel
CALM = 25  # per cent of the background that no curtain or screen covers
EXPLAINED = 0.5  # of the changes of soft light that one motion of the picture must explain


@dataclass(frozen=True)
class Plain:
    """What edges say of the camera: the share of their pixels that stay, a cell's mean, NaN without edges, and of cells where
    some do; `drift_px` is how far what stays moves (median, of the frames' px), NaN if nothing does; `sways`: where there are
    no edges, soft light moves as one.
    """

    stays: float
    cells: float
    drift_px: float
    sways: bool

    @property
    def still(self) -> bool:
        """Whether most of the edges stay, or some do all over the picture, though a screen or a shadow moves."""
        return self.stays >= MOST or (self.stays >= STAYS and self.cells >= MOST)

    @property
    def moves(self) -> bool:
        """Whether something shows that the camera moves: no edges stay, or the light on a wall without any moves as one."""
        told = not np.isnan(self.stays)
        return (self.stays < SOME or self.cells < COVERED) if told else self.sways

    def facts(self) -> dict[str, float | None]:
        """For sfm.json; None where there are no edges."""
        found = {"displacement_px": self.drift_px, "stays": self.stays}
        return {name: None if np.isnan(value) else round(value, 4) for name, value in found.items()}


@dataclass(frozen=True)
class Views:
    """Pictures of a clip, equally bright: float32 [F,h,w], smoothed, and where each shows the background bool [F,h,w].

    `frames` [F] are their positions in the clip; `noise` is a smoothed pixel's, of 255; `scale` makes px of the frames of theirs.
    """

    frames: np.ndarray
    grey: np.ndarray
    seen: np.ndarray
    noise: float
    scale: float


def look(images: Path, ignored: Path, files: list[str]) -> Views:
    """Pictures spread over the whole clip; `ignored` has a mask of the same name for each, 0 = not looked at."""
    chosen = np.array(evenly(len(files), LOOKED_AT))
    grey, seen, rough, scale = [], [], [], 1.0
    for file in [files[i] for i in chosen]:
        picture, there, scale = picture_of(images, ignored, file)
        smooth = cv2.GaussianBlur(picture, (0, 0), BLUR)
        rough.append(roughness(picture, smooth, there))
        grey.append(smooth)
        seen.append(shrunk(there))
    bars = cv2.dilate((np.max(grey, 0) < BLACK).astype(np.uint8), REACH) > 0
    free = np.array(seen) & ~bars
    return Views(chosen, _equally_bright(np.array(grey), free), free, noise_of(rough), scale)


def picture_of(images: Path, ignored: Path, file: str) -> tuple[np.ndarray, np.ndarray, float]:
    """A grey picture float32 [h,w] of SIDE px at most, where it shows the background bool [h,w], and px of the frame for its."""
    whole = cv2.cvtColor(read_image(images / file), cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = max(max(whole.shape) / SIDE, 1.0)
    size = tuple(round(length / scale) for length in whole.shape[::-1])
    there = cv2.resize(read_mask(ignored / file), size, interpolation=cv2.INTER_NEAREST) > 0
    return cv2.resize(whole, size, interpolation=cv2.INTER_AREA), there, scale


def shrunk(there: np.ndarray) -> np.ndarray:
    """Where pixels bool [h,w], smoothed by BLUR, are as good as untouched by others."""
    return np.asarray(cv2.erode(there.astype(np.uint8), REACH, borderValue=1)) > 0


def roughness(picture: np.ndarray, smooth: np.ndarray, there: np.ndarray) -> float:
    """How far pixels `there` bool [h,w] usually are from those smoothed by BLUR, of 255."""
    return np.median(np.abs(picture - smooth)[there]) if there.any() else 0.0


def noise_of(rough: list[float]) -> float:
    """A smoothed pixel's noise by the `roughness` of pictures: a Gaussian's, smoothed by a Gaussian."""
    return 1.48 * float(np.median(rough)) / (2 * BLUR * np.sqrt(np.pi))


def judge(views: Views) -> Plain:
    """What the edges of the pictures say of the camera."""
    often = views.seen.sum(0) >= max(HALF * len(views.seen), 2)
    limit, mean = STATIC_PX * max(often.shape), _mean(views.grey, views.seen)
    varies = np.sqrt(_mean((views.grey - mean) ** 2, views.seen))
    slopes = [slopes_of(picture) for picture in views.grey]
    steep = np.sqrt(_mean(np.array([x**2 + y**2 for x, y in slopes]), views.seen))
    lasting = np.hypot(*(_mean(np.array(slope), views.seen) for slope in zip(*slopes, strict=True)))
    edge = often & (limit * steep >= max(EXISTS, NOISE * views.noise))
    y, x = np.nonzero(edge)
    moved = varies[edge] / np.maximum(lasting[edge], 1e-6)
    height, width = edge.shape
    cell = y * CELLS // height * CELLS + x * CELLS // width
    share = np.array([(moved[cell == i] < limit).mean() for i in np.unique(cell) if (cell == i).sum() >= FEW])
    if not len(share):
        return Plain(np.nan, 0.0, np.nan, _sways(views, often, mean, limit))
    drift = float(np.median(moved[moved < limit])) * views.scale if (moved < limit).any() else np.nan
    return Plain(float(share.mean()), float((share >= STAYS).mean()), drift, sways=False)


def standing_part(views: Views) -> np.ndarray | None:
    """Positions in the clip of the longest run of pictures, half of them at least, from its start or to its end, in which
    the camera stands; None if there is none.
    """
    count = len(views.frames)
    for length in range(count - 1, max(math.ceil(HALF * count), 2) - 1, -1):
        for run in (slice(0, length), slice(count - length, count)):
            if judge(replace(views, frames=views.frames[run], grey=views.grey[run], seen=views.seen[run])).still:
                return views.frames[run]
    return None


def _sways(views: Views, often: np.ndarray, mean: np.ndarray, limit: float) -> bool:
    """Whether one motion of the whole picture, farther than `limit`, explains how its soft light changes."""
    if not often.any():
        return False
    soft = cv2.GaussianBlur(np.where(often, mean, mean[often].mean()), (0, 0), SOFT)
    inner = cv2.erode(often.astype(np.uint8), np.ones((2 * round(SOFT) + 1,) * 2, np.uint8)) > 0
    changed, explained, ways = 0.0, 0.0, []
    for picture, seen in zip(views.grey, views.seen, strict=True):
        there = inner & seen
        if there.sum() < FEW:
            continue
        change = cv2.GaussianBlur(np.where(seen & often, picture - mean, 0), (0, 0), SOFT)[there]
        light = np.stack([np.ones(there.sum()), soft[there]], 1)
        both = np.concatenate([np.stack([slope[there] for slope in slopes_of(soft)], 1), light], 1)
        change = change - light @ np.linalg.lstsq(light, change)[0]
        way, left = np.linalg.lstsq(both, change)[:2]
        changed += float((change**2).sum())
        explained += float((change**2).sum() - left.sum())
        ways.append(way[:2])
    if len(ways) < 2:
        return False
    return explained > EXPLAINED * changed and float(np.sqrt((np.array(ways) ** 2).sum(1).mean())) > limit


def _equally_bright(grey: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The pictures [F,h,w] as bright as the middle one, by the background that both show: a gain and an offset each.

    A picture whose calmest quarter that would change more stays: what moves there covers most of it.
    """
    middle, found = len(grey) // 2, grey.copy()
    for picture, own, free in zip(found, grey, seen, strict=True):
        shown = both = free & seen[middle]
        for _ in range(2):
            if not both.any():
                break
            mine, aim = picture[both], grey[middle][both]
            varies = ((mine - mine.mean()) * (aim - aim.mean())).mean(), mine.var()
            gain = (varies[0] + EXISTS) / (varies[1] + EXISTS)  # 1 where a picture hardly varies
            picture[:] = gain * (picture - mine.mean()) + aim.mean()
            left = np.abs(picture - grey[middle])
            both = both & (left <= 2 * np.median(left[both]) + EXISTS)  # what moves does not count
        if shown.any():
            changes = [np.percentile(np.abs(one - grey[middle])[shown], CALM) for one in (picture, own)]
            picture[:] = picture if changes[0] <= changes[1] else own
    return found


def _mean(pictures: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return (pictures * seen).sum(0) / np.maximum(seen.sum(0), 1)


def slopes_of(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change of brightness a px along x and y."""
    y, x = np.gradient(picture)
    return x, y

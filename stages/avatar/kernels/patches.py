"""Patches of a picture that look alike, for its holes: found by PatchMatch, then laid over each other.

Barnes et al. 2009 (PatchMatch); Wexler et al. 2007 (Space-Time Completion of Video), which takes turns with both.
"""

from __future__ import annotations

import numpy as np

from stages.avatar.kernels import njit

REACH = 3  # px from the middle of a patch to its border
ROUNDS = 4  # over all patches
ASIDE = 4.0  # times as far to the side as up or down a patch may come from: floors, walls and shelves lie level


@njit(cache=True)
def _cost(picture, y, x, v, u, far, most):
    """Squared difference of the patches at (y, x) and (v, u), and how far apart they are; where it is over `most`, any that is."""
    down, aside = (v - y) / far, (u - x) / (ASIDE * far)
    cost = down * down + aside * aside
    for dy in range(-REACH, REACH + 1):
        if cost >= most:
            return cost
        for dx in range(-REACH, REACH + 1):
            for c in range(picture.shape[2]):
                gap = picture[y + dy, x + dx, c] - picture[v + dy, u + dx, c]
                cost += gap * gap
    return cost


@njit(cache=True)
def search(
    picture: np.ndarray,
    wanted: np.ndarray,
    row: np.ndarray,
    found: np.ndarray,
    sources: np.ndarray,
    far: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Improve, in place, which patches of picture[H,W,C] are most like those wanted; returns their costs [T].

    wanted[T,2] are middles (y, x), row[H,W] their rows, -1 elsewhere; found[T,2] the middles so far, which must be among
    sources[H,W]. A patch `far` px above or below costs as much as one whose squares of differences add up to 1.
    """
    height, width = sources.shape
    costs = np.empty(len(wanted))
    for t in range(len(wanted)):
        costs[t] = _cost(picture, wanted[t, 0], wanted[t, 1], found[t, 0], found[t, 1], far, np.inf)
    for turn in range(ROUNDS):
        step = 1 if turn % 2 == 0 else -1
        for k in range(len(wanted)):
            t = k if step == 1 else len(wanted) - 1 - k
            y, x = wanted[t, 0], wanted[t, 1]
            radius = 2.0 * max(height, width)
            for attempt in range(64):
                if attempt < 2:  # what goes on from the neighbours' patches
                    ny, nx = (y - step, x) if attempt == 0 else (y, x - step)
                    if not (0 <= ny < height and 0 <= nx < width) or row[ny, nx] < 0:
                        continue
                    v, u = found[row[ny, nx], 0] + y - ny, found[row[ny, nx], 1] + x - nx
                else:
                    radius /= 2
                    if radius < 1:
                        break
                    v = found[t, 0] + int(radius * (2 * rng.random() - 1))
                    u = found[t, 1] + int(radius * (2 * rng.random() - 1))
                if 0 <= v < height and 0 <= u < width and sources[v, u]:
                    cost = _cost(picture, y, x, v, u, far, costs[t])
                    if cost < costs[t]:
                        costs[t], found[t, 0], found[t, 1] = cost, v, u
    return costs


@njit(cache=True)
def overlay(
    picture: np.ndarray, hole: np.ndarray, row: np.ndarray, found: np.ndarray, costs: np.ndarray, spread: float
) -> np.ndarray:
    """The picture [H,W,C] with its hole [H,W] filled: each pixel the mean of what the patches over it say.

    A patch whose cost is over the least by 2 x `spread` counts 1/e; `row`, `found`, `costs` as in `search`.
    """
    filled = picture.copy()
    height, width = hole.shape
    at = np.argwhere(hole)
    for k in range(len(at)):
        y, x = at[k, 0], at[k, 1]
        least = np.inf
        for ny in range(max(0, y - REACH), min(height, y + REACH + 1)):
            for nx in range(max(0, x - REACH), min(width, x + REACH + 1)):
                if row[ny, nx] >= 0:
                    least = min(least, costs[row[ny, nx]])
        total = 0.0
        filled[y, x] = 0
        for ny in range(max(0, y - REACH), min(height, y + REACH + 1)):
            for nx in range(max(0, x - REACH), min(width, x + REACH + 1)):
                t = row[ny, nx]
                if t >= 0:
                    counts = np.exp((least - costs[t]) / (2 * spread))
                    total += counts
                    for c in range(picture.shape[2]):
                        filled[y, x, c] += counts * picture[found[t, 0] + y - ny, found[t, 1] + x - nx, c]
        for c in range(picture.shape[2]):
            filled[y, x, c] /= total
    return filled

"""Completes a picture where nothing is known of it, with patches of what is: in a small picture first, then in larger ones."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from stages.avatar.kernels.patches import REACH, overlay, search

DEEP = 16.0  # px at most to a hole's border in the smallest picture, which is at most half as large, if enough is known in it
FAR = 0.07  # of the longer side: a patch from so far above or below has to look better by 1, see `search`
FIRST, THEN, LAST = 24, 12, 4  # turns, at most, in the smallest picture, in larger ones and in the largest
STILL = 1e-4  # mean change in a turn, of 1, from which on it is done
SHARP = 0.02  # spread of an overlay at least: each pixel is that of the best patches over it
SOFTENED = 4.0  # px: sigma of the colours around that a patch has to agree with, see `_softened`
PATCH = np.ones((2 * REACH + 1, 2 * REACH + 1), bool)


class _Patches(NamedTuple):
    """Patches over a hole: their middles `wanted` [T,2], their `row` [H,W] there, -1 elsewhere, and `found` [T,2] like them."""

    wanted: np.ndarray
    row: np.ndarray
    found: np.ndarray


def complete(picture: np.ndarray, hole: np.ndarray) -> np.ndarray | None:
    """A picture float[H,W,3] in 0..1 whose hole [H,W] is filled; None where too little of it is known to fill it from.

    What is filled in is invented: it goes on as what is around it does, most of all what is level with it. Wexler et al. 2007.
    Patches must agree with a smooth filling, too: that is nearer to the truth than any one of them, and they bring its detail.
    """
    sizes = [(picture.astype(np.float32), hole)]
    if not hole.any():
        return sizes[0][0]
    deep = distance_transform_edt(np.pad(hole, 1)).max()
    for _ in range(max(1, math.ceil(math.log2(deep / DEEP)))):
        sizes.append(_half(*sizes[-1]))
    while sizes and not (sizes[-1][1].any() and _sources(sizes[-1][1]).any()):
        sizes.pop()
    if not sizes:
        return None
    smallest, hole = sizes[-1]
    patches, smooth = _anywhere(hole), _softened(smallest, hole)
    filled = _settled(np.where(hole[..., None], smooth, smallest), smooth, hole, patches, FIRST)
    for known, hole in reversed(sizes[:-1]):
        patches = _twice_as_large(patches, hole)
        filled = _laid(known, hole, patches)
        filled = _settled(filled, _softened(known, hole), hole, patches, LAST if known is sizes[0][0] else THEN)
    return _laid(filled, hole, patches)


def membrane(values: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Values [H,W] whose hole [H,W] is filled: each there is the mean of its neighbours (Laplace's equation).

    So what is linear around a hole is linear in it. In a hole without any border all are 0.
    """
    rows = np.full(hole.shape, -1)
    rows[hole] = np.arange(hole.sum())
    neighbours = [(rows[:, :-1], rows[:, 1:], values[:, 1:]), (rows[:, 1:], rows[:, :-1], values[:, :-1])]
    neighbours += [(rows[:-1], rows[1:], values[1:]), (rows[1:], rows[:-1], values[:-1])]
    count, around, links = np.full(hole.sum(), 1e-9), np.zeros(hole.sum()), []
    for own, other, value in neighbours:
        count += np.bincount(own[own >= 0], minlength=len(count))
        edge = (own >= 0) & (other < 0)
        around += np.bincount(own[edge], value[edge], len(count))
        links.append(np.stack([own, other])[:, (own >= 0) & (other >= 0)])
    own, other = np.concatenate(links, 1)
    filled = values.astype(np.float64)
    if len(count):
        laplacian = diags(count) - coo_matrix((np.ones(len(own)), (own, other)), (len(count), len(count)))
        filled[hole] = spsolve(laplacian.tocsc(), around, permc_spec="MMD_AT_PLUS_A")
    return filled


def _softened(picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """What is known [H,W,3], blurred, and in the hole [H,W] a membrane of what is around."""
    known = (~hole).astype(np.float32)
    share = np.maximum(gaussian_filter(known, SOFTENED), 1e-6)
    parts = [
        np.where(hole, membrane(part, hole), gaussian_filter(part * known, SOFTENED) / share)
        for part in np.moveaxis(picture, -1, 0)
    ]
    return np.stack(parts, -1).astype(np.float32)


def _laid(picture: np.ndarray, hole: np.ndarray, patches: _Patches) -> np.ndarray:
    """The picture with the mean of all patches over each pixel of its hole."""
    return overlay(picture, hole, patches.row, patches.found, np.zeros(len(patches.found)), 1.0)


def _settled(picture: np.ndarray, smooth: np.ndarray, hole: np.ndarray, patches: _Patches, turns: int) -> np.ndarray:
    """The picture after as many turns of searching and overlaying; `patches.found` are improved in place.

    Patches are compared in their colours and in those of `smooth` [H,W,3].
    """
    sources, costs, rng = _sources(hole), np.zeros(0), np.random.default_rng(0)
    for _ in range(turns):
        costs = search(np.concatenate([picture, smooth], 2), *patches, sources, FAR * max(hole.shape), rng)
        before, spread = picture, max(np.quantile(costs, 0.75) / 2, SHARP)
        picture = overlay(picture, hole, patches.row, patches.found, costs, spread)
        if np.abs(picture - before)[hole].mean() < STILL:
            break
    return overlay(picture, hole, patches.row, patches.found, costs, SHARP)


def _half(picture: np.ndarray, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both at half the size: colours are those of what is known, a pixel is in the hole if most of it is."""
    size = -(-hole.shape[1] // 2), -(-hole.shape[0] // 2)
    known = (~hole).astype(np.float32)
    share = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    colours = cv2.resize(picture * known[..., None], size, interpolation=cv2.INTER_AREA)
    return colours / np.maximum(share, 1e-6)[..., None], share < 0.5


def _sources(hole: np.ndarray) -> np.ndarray:
    """Middles [H,W] of patches that lie in the picture and touch no hole."""
    return ~binary_dilation(np.pad(hole, REACH, constant_values=True), PATCH)[REACH:-REACH, REACH:-REACH]


def _anywhere(hole: np.ndarray) -> _Patches:
    """The patches over a hole, each with one of the sources by chance."""
    over = binary_dilation(hole, PATCH)
    over[:REACH], over[-REACH:], over[:, :REACH], over[:, -REACH:] = False, False, False, False
    wanted, row = np.argwhere(over), np.full(hole.shape, -1)
    row[over] = np.arange(len(wanted))
    sources = np.argwhere(_sources(hole))
    return _Patches(wanted, row, sources[np.random.default_rng(0).integers(0, len(sources), len(wanted))])


def _twice_as_large(patches: _Patches, hole: np.ndarray) -> _Patches:
    """The patches over a hole [H,W], with what was found in the picture of half the size."""
    now, (height, width) = _anywhere(hole), hole.shape
    before = patches.row[now.wanted[:, 0] // 2, now.wanted[:, 1] // 2]
    guess = 2 * patches.found[before] + now.wanted % 2
    inside = (before >= 0) & (guess[:, 0] < height) & (guess[:, 1] < width)
    known = np.zeros(len(guess), bool)
    known[inside] = _sources(hole)[guess[inside, 0], guess[inside, 1]]
    now.found[known] = guess[known]
    return now

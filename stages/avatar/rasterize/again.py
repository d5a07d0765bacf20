"""The next picture of a film on a CPU: only blocks of 4x4 px in which something changed are drawn again.

While the camera stands still, Gaussians that stayed keep their place on the screen and in the lists of tiles. A Gaussian that moved
is taken out of the lists and merged in anew, and the blocks that it reached and reaches are blended.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from stages.avatar.kernels import njit, prange
from stages.avatar.rasterize import blend
from stages.avatar.rasterize import projection as kernels
from stages.avatar.rasterize.cpu import CHUNKS, as_array, empty_records
from stages.avatar.rasterize.projection import BLUE, DEPTH, GREEN, RED
from stages.avatar.rasterize.rendering import T_STOP, Camera, Gaussians, Kept, Layer, Rendering
from stages.avatar.rasterize.tiles import AHEAD, tile_lists

SAME, TINTED, MOVED = 0, 1, 2
SHADE = np.float32(0.5 / 255)  # weights of a pixel sum to 1 at most, so a picture is off by no more than its colours


@dataclass
class _State:
    """N Gaussians as last drawn: means, axes, opacities and colours; on the screen; in the lists of tiles; and the picture."""

    key: tuple[Any, ...]
    arrays: list[np.ndarray]
    records: np.ndarray
    means2d: np.ndarray
    radii: np.ndarray
    dropped: int
    lists: tuple[np.ndarray, np.ndarray, np.ndarray]
    wanted: np.ndarray
    pictures: list[np.ndarray]


def redraw(gaussians: Gaussians, camera: Camera, layer: Layer, near: float, kept: Kept) -> Rendering:
    """As `cpu.rasterize` of one layer, without gradients; colours that changed by SHADE at most stay as they were.

    ValueError for a part of a picture or of the Gaussians.
    """
    *parts, antialias = gaussians
    arrays = [as_array(part) for part in parts]
    view, K = as_array(camera.viewmat, np.float64), as_array(camera.K, np.float64)
    ground = np.zeros(3, np.float32) if layer.background is None else as_array(layer.background)
    lens = view, K, camera.width, camera.height, antialias, near
    key = len(arrays[0]), view.tobytes(), K.tobytes(), *lens[2:], ground.tobytes()
    if layer.rows is not None or layer.window is not None:
        raise ValueError("only whole pictures of all Gaussians are kept")
    before: _State | None = kept.state
    state = _first(key, arrays, lens) if before is None or before.key != key else _next(before, arrays, lens)
    starts, rows, masks = state.lists
    window, threads = (0, 0, camera.width, camera.height), torch.get_num_threads()
    place = starts, rows, masks, state.records.reshape(-1), window, ground, threads, blend.IN_X, blend.IN_Y
    ends = [np.empty((len(starts) - 1, blend.AREA), kind) for kind in (np.float32, np.int32)]
    blend.draw(*place, state.wanted, np.float32(T_STOP), *state.pictures, *ends)
    kept.state = state
    image, alpha, depth, means2d, radii = (
        torch.from_numpy(part.copy()) for part in (*state.pictures, state.means2d, state.radii)
    )
    none = torch.zeros_like(means2d)
    return Rendering(image, alpha, depth, means2d, radii, none, none, state.dropped)


def _first(key: tuple[Any, ...], arrays: list[np.ndarray], lens: tuple[Any, ...]) -> _State:
    """All of a picture."""
    n, (_, _, width, height, *_) = len(arrays[0]), lens
    records, means2d, radii = empty_records(n), np.empty((n, 2), np.float32), np.empty(n, np.float32)
    dropped = int(kernels.project(*arrays, *lens, CHUNKS, records, means2d, radii))
    lists = tile_lists(kernels.depth_order(records, radii), records.reshape(-1), (0, 0, width, height), CHUNKS)
    pictures = [np.empty((height, width, *rest), np.float32) for rest in ((3,), (), ())]
    wanted = np.full(len(lists[0]) - 1, blend.ALL)
    return _State(key, [*arrays[:3], arrays[3].copy()], records, means2d, radii, dropped, lists, wanted, pictures)


def _next(state: _State, arrays: list[np.ndarray], lens: tuple[Any, ...]) -> _State:
    """The state with what is other in the `arrays`, and the blocks that this changes as `wanted`."""
    what, colors = np.empty(len(state.radii), np.uint8), state.arrays[3]
    _compare(*state.arrays[:3], *arrays, CHUNKS, colors, state.records, what)
    moved = np.flatnonzero(what == MOVED)
    records, means2d = empty_records(len(moved)), np.empty((len(moved), 2), np.float32)
    radii = np.empty(len(moved), np.float32)
    state.dropped = int(kernels.project(*(part[moved] for part in arrays), *lens, CHUNKS, records, means2d, radii))
    order = moved.astype(np.int32)[kernels.depth_order(records, radii)]
    state.records[moved], state.means2d[moved], state.radii[moved] = records, means2d, radii
    fresh = tile_lists(order, state.records.reshape(-1), (0, 0, *lens[2:4]), CHUNKS)
    state.arrays[:3] = arrays[:3]
    counts, state.wanted = np.zeros(len(fresh[0]), np.int64), np.zeros(len(fresh[0]) - 1, np.uint64)
    _count(*state.lists, *fresh, what, counts, state.wanted)
    starts = counts.cumsum()
    rows, masks = np.zeros(starts[-1] + AHEAD, np.int32), np.zeros(starts[-1] + AHEAD, np.uint64)
    _merge(*state.lists, *fresh, what, state.records, starts, rows, masks)
    state.lists = starts, rows, masks
    return state


@njit(cache=True, parallel=True)
def _compare(
    means0: np.ndarray,
    axes0: np.ndarray,
    opacities0: np.ndarray,
    means: np.ndarray,
    axes: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    chunks: int,
    drawn: np.ndarray,
    records: np.ndarray,
    what: np.ndarray,
) -> None:
    """Fill what [N] with SAME, TINTED or MOVED, and take colours that are other into `drawn` [N,3] and records [N,16].

    What is not finite has moved.
    """
    n = len(means)
    for chunk in prange(chunks):
        for i in range(chunk * n // chunks, (chunk + 1) * n // chunks):
            away, shade = abs(opacities[i] - opacities0[i]), np.float32(0)
            for c in range(3):
                away += abs(means[i, c] - means0[i, c])
                for r in range(3):
                    away += abs(axes[i, r, c] - axes0[i, r, c])
                shade = max(shade, abs(colors[i, c] - drawn[i, c]))
            what[i] = MOVED if not (away == 0 and math.isfinite(shade)) else TINTED if shade > SHADE else SAME
            if what[i] != SAME:
                for c in range(3):
                    drawn[i, c] = colors[i, c]
                records[i, RED], records[i, GREEN], records[i, BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]


@njit(cache=True, parallel=True)
def _count(
    starts: np.ndarray,
    rows: np.ndarray,
    masks: np.ndarray,
    fresh_starts: np.ndarray,
    fresh_rows: np.ndarray,
    fresh_masks: np.ndarray,
    what: np.ndarray,
    counts: np.ndarray,
    wanted: np.ndarray,
) -> None:
    """Count into counts [1+tiles] what each list will hold, and mark in wanted [tiles] the blocks that change."""
    for tile in prange(len(wanted)):
        bits, count = np.uint64(0), 0
        for k in range(starts[tile], starts[tile + 1]):
            kind = what[rows[k]]
            if kind != SAME:
                bits |= masks[k]
            count += kind != MOVED and masks[k] != np.uint64(0)
        for k in range(fresh_starts[tile], fresh_starts[tile + 1]):
            bits |= fresh_masks[k]
            count += fresh_masks[k] != np.uint64(0)
        counts[tile + 1], wanted[tile] = count, bits


@njit(cache=True, parallel=True)
def _merge(
    starts: np.ndarray,
    rows: np.ndarray,
    masks: np.ndarray,
    fresh_starts: np.ndarray,
    fresh_rows: np.ndarray,
    fresh_masks: np.ndarray,
    what: np.ndarray,
    records: np.ndarray,
    places: np.ndarray,
    all_rows: np.ndarray,
    all_masks: np.ndarray,
) -> None:
    """Merge what stayed in lists and what is fresh, nearest first, ties by row, into all_rows and all_masks at places [1+tiles]."""
    for tile in prange(len(starts) - 1):
        i, j = starts[tile], fresh_starts[tile]
        for at in range(places[tile], places[tile + 1]):
            while i < starts[tile + 1] and (what[rows[i]] == MOVED or masks[i] == np.uint64(0)):
                i += 1
            while j < fresh_starts[tile + 1] and fresh_masks[j] == np.uint64(0):
                j += 1
            first = j == fresh_starts[tile + 1]
            if not first and i < starts[tile + 1]:
                stays, comes = records[rows[i], DEPTH], records[fresh_rows[j], DEPTH]
                first = stays < comes or (stays == comes and rows[i] < fresh_rows[j])
            if first:
                all_rows[at], all_masks[at] = rows[i], masks[i]
                i += 1
            else:
                all_rows[at], all_masks[at] = fresh_rows[j], fresh_masks[j]
                j += 1

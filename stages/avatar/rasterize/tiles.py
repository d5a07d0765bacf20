"""Which Gaussians a tile must look at, nearest first, and which of its 64 blocks each of them reaches.

A tile is 32x32 px, a block 4x4. Along a band of blocks (4 px rows) an ellipse covers one interval of x, whose ends have a
closed form; the eight bands of a tile row are worked out in one go, one lane a band.
"""

from __future__ import annotations

import math

import numpy as np

from stages.avatar.kernels import njit, prange
from stages.avatar.kernels.lanes import LANES, bits_between, down, fma, greater, lesser, magnitude, root, select, up
from stages.avatar.kernels.memory import load, peek, prefetch
from stages.avatar.rasterize.projection import (
    CUT,
    INVERSE_DET,
    LOG2E,
    QA,
    REACH_X,
    REACH_Y,
    ROW,
    SLANT_X,
    SLOPE,
    X,
    Y,
)

TILE = 32  # px
BLOCK = 4  # px
ACROSS = TILE // BLOCK
SPREAD = 7  # has no factor in common with the number of chunks
AHEAD = 8  # Gaussians between the request for a record and its use
FAR = np.float32(1e6)  # blocks; farther than any picture reaches
BANDS = np.full(LANES, FAR, np.float32)  # px from the first row of a tile to that of each band; 8 lanes have none
BANDS[:ACROSS] = BLOCK * np.arange(ACROSS)
HALF, ZERO = np.float32(0.5), np.float32(0)
SHADE, SHADE_PX = np.float32(2e-4), np.float32(1e-3)  # too wide, so that rounding never drops a pixel that is drawn


@njit(cache=True, inline="always")
def _blocks(records, at, left, top, width, bands):
    """First and last block column of the window that a Gaussian reaches in each band of the tile row at `top` px.

    `records` is flat and `at` the start of the Gaussian's; `left` and `top` are px of the whole picture, `width` px the
    window's. Two vectors of whole numbers, first > last where the band is missed.
    """
    reach_x, reach_y, slant = peek(records, at + REACH_X), peek(records, at + REACH_Y), peek(records, at + SLANT_X)
    a = np.float32(-2 / LOG2E) * peek(records, at + QA)
    b, inverse = a * peek(records, at + SLOPE), np.float32(1) / a
    room, det = peek(records, at + CUT) * a, peek(records, at + INVERSE_DET)
    x = peek(records, at + X) - np.float32(left) - HALF
    start = load(bands, 0) + (np.float32(top) + HALF - peek(records, at + Y))
    high, low = greater(start, -reach_y), lesser(start + np.float32(BLOCK - 1), reach_y)  # rows, relative to the mean
    one = root(greater(room - det * high * high, ZERO))
    two = root(greater(room - det * low * low, ZERO))
    ahead = greater(one - b * high, two - b * low) * inverse
    ahead = select((high <= slant) & (low >= slant), reach_x, fma(magnitude(ahead), SHADE, ahead) + SHADE_PX)
    back = greater(one + b * high, two + b * low) * inverse
    back = select((high <= -slant) & (low >= -slant), reach_x, fma(magnitude(back), SHADE, back) + SHADE_PX)
    first = greater(up(x - back), ZERO)
    last = lesser(down(x + ahead), np.float32(width - 1))
    hit = (high <= low) & (first <= last)
    quarter = np.float32(1 / BLOCK)
    return select(hit, down(first * quarter), FAR), select(hit, down(last * quarter), -FAR)


@njit(cache=True, inline="always")
def _tile_range(middle, reach, tiles):
    """First and last of `tiles` tiles along one side that the interval middle +- reach px touches."""
    first = math.floor(max(middle - reach, ZERO) * np.float32(1 / TILE))
    last = math.floor(min(middle + reach, np.float32(TILE * tiles)) * np.float32(1 / TILE))
    return first, min(last, tiles - 1)


@njit(cache=True, parallel=True)
def _walk(order, records, left, top, width, height, bands, counts, writing, rows, masks):
    """Count the Gaussians whose rectangle touches each tile into counts [chunks,tiles], or write those that reach a block of it
    where `counts` says.
    """
    across, deep = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    chunks, n = len(counts), len(order)
    for job in prange(chunks):
        chunk = SPREAD * job % chunks  # near Gaussians are large: no thread should have all of them
        for k in range(chunk * n // chunks, (chunk + 1) * n // chunks):
            at = np.int64(peek(order, k)) * ROW
            prefetch(records, np.int64(peek(order, min(k + AHEAD, n - 1))) * ROW)
            x, y = peek(records, at + X) - np.float32(left), peek(records, at + Y) - np.float32(top)
            first_column, last_column = _tile_range(x, peek(records, at + REACH_X), across)
            first_row, last_row = _tile_range(y, peek(records, at + REACH_Y), deep)
            for row in range(first_row, last_row + 1):
                if not writing:  # a place too many costs less than the ends of eight bands
                    for column in range(first_column, last_column + 1):
                        counts[chunk, row * across + column] += 1
                    continue
                first, last = _blocks(records, at, left, top + TILE * row, width, bands)
                for column in range(first_column, last_column + 1):
                    shift = np.float32(ACROSS * column)
                    bits = bits_between(first - shift, last - shift)
                    if bits != np.uint64(0):
                        tile = row * across + column
                        rows[counts[chunk, tile]] = order[k]
                        masks[counts[chunk, tile]] = bits
                        counts[chunk, tile] += 1


def tile_lists(
    order: np.ndarray, records: np.ndarray, window: tuple[int, int, int, int], chunks: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What each tile of a window (left, top, right, bottom) px has to blend: (starts [tiles+1], rows, masks).

    `order` lists Gaussians, nearest first, and records [N*16] is flat. Bit `8 row + column` of a mask stands for a block.
    Places that nobody took have masks of 0. Rows and masks run on a little beyond the last entry, so that a reader may look ahead.
    """
    left, top, right, bottom = window
    tiles = math.ceil((right - left) / TILE) * math.ceil((bottom - top) / TILE)
    counts, nothing = np.zeros((chunks, tiles), np.int64), (np.empty(0, np.int32), np.empty(0, np.uint64))
    place = (order, records, left, top, right - left, bottom - top, BANDS)
    _walk(*place, counts, False, *nothing)
    ends = counts.T.cumsum()
    starts = np.append(0, ends[chunks - 1 :: chunks])
    rows, masks = np.zeros(starts[-1] + AHEAD, np.int32), np.zeros(starts[-1] + AHEAD, np.uint64)
    _walk(*place, np.ascontiguousarray((ends - counts.T.ravel()).reshape(tiles, chunks).T), True, rows, masks)
    return starts, rows, masks

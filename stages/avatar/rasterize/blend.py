"""The blend on a CPU: tiles of 32x32 px, Gaussians outside, blocks of 4x4 px inside, one lane a pixel.

A 64-bit word says which of a tile's 64 blocks a Gaussian reaches; most reach one or two, and only those are computed.
Exponents are kept in log2. Front to back, the working T goes on shrinking after a pixel is finished, so "T(1-alpha) is
above the stop" alone decides whether a Gaussian counts, and no flag is carried. Back to front, one number S a pixel
stands for all that lies behind, and only moments of g = alpha dL/dalpha are summed for each Gaussian.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from stages.avatar.rasterize.kernels import (
    ABS_Y,
    BLUE,
    DEPTH,
    GREEN,
    LOG2E,
    LOG_OPACITY,
    QA,
    QB,
    QC,
    REACH_X,
    REACH_Y,
    RED,
    TILE,
    X,
    Y,
    interval,
)
from stages.avatar.rasterize.lanes import (
    LANES,
    any_lane,
    at_most,
    count_trailing_zeros,
    exp2,
    fma,
    lesser,
    load,
    load_index,
    magnitude,
    select,
    select_index,
    spread,
    store,
    store_index,
    total,
)
from stages.avatar.rasterize.rendering import ALPHA_MAX, ALPHA_MIN, T_STOP

ACROSS = TILE // 4
BLOCKS = ACROSS * ACROSS
AREA = BLOCKS * LANES
SMALL = 3.0  # px: below this reach the bounding box is as good as the ellipse
FAINTEST = np.float32(math.log2(ALPHA_MIN))
LARGEST, STOP = np.float32(ALPHA_MAX), np.float32(T_STOP)
IN_X = np.tile(np.arange(4, dtype=np.float32) + np.float32(0.5), 4)
IN_Y = np.repeat(np.arange(4, dtype=np.float32) + np.float32(0.5), 4)
SUMS = ABS_Y + 1
ROW = 16  # floats in a record and in a gradient row: one cache line
ZERO, ONE = np.float32(0), np.float32(1)
A_TWICE, B_ONCE = np.float32(2 / LOG2E), np.float32(1 / LOG2E)


@njit(cache=True, inline="always")
def _blocks(r, left, top):
    """The blocks of the tile at (left, top) px that a Gaussian reaches, as bits."""
    half = np.float32(0.5)
    x, y = r[X] - np.float32(left) - half, r[Y] - np.float32(top) - half
    low, high = math.ceil(y - r[REACH_Y]), math.floor(y + r[REACH_Y])
    low, high = max(low, 0) >> 2, min(high, TILE - 1) >> 2
    bits = np.uint64(0)
    small = r[REACH_X] < SMALL and r[REACH_Y] < SMALL
    near, far = -r[REACH_X], r[REACH_X]
    for band in range(low, high + 1):
        if not small:
            near, far = interval(r, np.float32(4 * band) - y, np.float32(4 * band + 3) - y)
            if near > far:
                continue
        first, last = max(math.ceil(x + near), 0), min(math.floor(x + far), TILE - 1)
        if first <= last:
            row = (np.uint64(2) << np.uint64(last >> 2)) - (np.uint64(1) << np.uint64(first >> 2))
            bits |= row << np.uint64(ACROSS * band)
    return bits


@njit(cache=True)
def _draw_tile(tile, starts, rows, records, left, top, width, height, state, last, in_x, in_y):
    """Blend one tile front to back into state [6,1024] (T, final T, red, green, blue, depth) and last [1024]."""
    live = np.uint64(0)
    for block in range(BLOCKS):
        x, y = left + 4 * (block % ACROSS), top + 4 * (block // ACROSS)
        if x < width and y < height:
            live |= np.uint64(1) << np.uint64(block)
        for lane in range(LANES):
            inside = x + lane % 4 < width and y + lane // 4 < height
            state[block * LANES + lane] = ONE if inside else ZERO
    state[AREA : 2 * AREA] = ONE
    state[2 * AREA :] = ZERO
    last[:] = -1
    inner_x, inner_y = load(in_x, 0), load(in_y, 0)
    for k in range(starts[tile], starts[tile + 1]):
        r = records[rows[k]]
        bits = _blocks(r, left, top) & live
        qa, qb, qc, log_opacity = r[QA], r[QB], r[QC], r[LOG_OPACITY]
        red, green, blue, depth = r[RED], r[GREEN], r[BLUE], r[DEPTH]
        to_x, to_y = np.float32(left) - r[X], np.float32(top) - r[Y]
        while bits != np.uint64(0):
            block = count_trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            at = block * LANES
            dx = inner_x + (to_x + np.float32(4 * (block & (ACROSS - 1))))
            dy = inner_y + (to_y + np.float32(4 * (block >> 3)))
            power = log_opacity - fma(dx, fma(dx, qa, dy * qb), dy * dy * qc)
            seen = power >= FAINTEST
            if not any_lane(seen):
                continue
            alpha = select(seen, lesser(exp2(lesser(power, log_opacity)), LARGEST), ZERO)
            light = load(state, at)
            share = alpha * light
            passed = light - share
            counts = seen & (passed > STOP)
            share = select(counts, share, ZERO)
            store(state, at, passed)
            store(state, AREA + at, select(counts, passed, load(state, AREA + at)))
            store(state, 2 * AREA + at, fma(share, red, load(state, 2 * AREA + at)))
            store(state, 3 * AREA + at, fma(share, green, load(state, 3 * AREA + at)))
            store(state, 4 * AREA + at, fma(share, blue, load(state, 4 * AREA + at)))
            store(state, 5 * AREA + at, fma(share, depth, load(state, 5 * AREA + at)))
            store_index(last, at, select_index(counts, k, load_index(last, at)))
            if not any_lane(passed > STOP):
                live &= ~(np.uint64(1) << np.uint64(block))
        if live == np.uint64(0):
            break


@njit(cache=True, parallel=True)
def draw(starts, rows, records, width, height, background, threads, in_x, in_y, image, alpha, depth, finals, lasts):
    """Blend all tiles: image [H,W,3] over background [3], alpha and depth [H,W]; finals and lasts [tiles,1024]."""
    across = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    for thread in prange(threads):
        state, last = np.empty(6 * AREA, np.float32), np.empty(AREA, np.int32)
        for tile in range(thread, tiles, threads):
            left, top = tile % across * TILE, tile // across * TILE
            _draw_tile(tile, starts, rows, records, left, top, width, height, state, last, in_x, in_y)
            finals[tile] = state[AREA : 2 * AREA]
            lasts[tile] = last
            for y in range(top, min(top + TILE, height)):
                for x in range(left, min(left + TILE, width)):
                    at = (((y - top) >> 2) * ACROSS + ((x - left) >> 2)) * LANES + ((y & 3) << 2) + (x & 3)
                    light = state[AREA + at]
                    image[y, x, 0] = state[2 * AREA + at] + light * background[0]
                    image[y, x, 1] = state[3 * AREA + at] + light * background[1]
                    image[y, x, 2] = state[4 * AREA + at] + light * background[2]
                    alpha[y, x] = ONE - light
                    depth[y, x] = state[5 * AREA + at]


@njit(cache=True)
def _tile_backward(tile, starts, rows, records, left, top, state, last, deepest, in_x, in_y, sums):
    """Walk one tile back to front; state [6,1024] holds T, S and dL/d(red, green, blue, depth) of each pixel."""
    inner_x, inner_y = load(in_x, 0), load(in_y, 0)
    end = -1
    for block in range(BLOCKS):
        deepest[block] = last[block * LANES : (block + 1) * LANES].max()
        end = max(end, deepest[block])
    for k in range(end, starts[tile] - 1, -1):
        i = rows[k]
        r = records[i]
        bits = _blocks(r, left, top)
        qa, qb, qc, log_opacity = r[QA], r[QB], r[QC], r[LOG_OPACITY]
        red, green, blue, depth = r[RED], r[GREEN], r[BLUE], r[DEPTH]
        to_x, to_y = np.float32(left) - r[X], np.float32(top) - r[Y]
        slope_a, slope_b, slope_c = A_TWICE * qa, B_ONCE * qb, A_TWICE * qc
        touched = False
        zero = spread(ZERO)
        s_g, s_x, s_y, s_xx, s_xy, s_yy = zero, zero, zero, zero, zero, zero
        s_red, s_green, s_blue, s_depth, s_ax, s_ay = zero, zero, zero, zero, zero, zero
        while bits != np.uint64(0):
            block = count_trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            if deepest[block] < k:
                continue
            at = block * LANES
            dx = inner_x + (to_x + np.float32(4 * (block & (ACROSS - 1))))
            dy = inner_y + (to_y + np.float32(4 * (block >> 3)))
            power = log_opacity - fma(dx, fma(dx, qa, dy * qb), dy * dy * qc)
            seen = (power >= FAINTEST) & at_most(k, load_index(last, at))
            if not any_lane(seen):
                continue
            touched = True
            full = exp2(lesser(power, log_opacity))
            alpha = select(seen, lesser(full, LARGEST), ZERO)
            through = ONE / (ONE - alpha)
            light = load(state, at) * through
            behind = load(state, AREA + at)
            v_red, v_green = load(state, 2 * AREA + at), load(state, 3 * AREA + at)
            v_blue, v_depth = load(state, 4 * AREA + at), load(state, 5 * AREA + at)
            value = fma(v_red, red, fma(v_green, green, fma(v_blue, blue, v_depth * depth)))
            share = alpha * light
            slope = value * light - behind * through
            store(state, at, light)
            store(state, AREA + at, fma(value, share, behind))
            g = select(full < LARGEST, alpha * slope, ZERO)
            gx, gy = g * dx, g * dy
            s_g, s_x, s_y = s_g + g, s_x + gx, s_y + gy
            s_xx, s_xy, s_yy = fma(gx, dx, s_xx), fma(gx, dy, s_xy), fma(gy, dy, s_yy)
            s_red, s_green = fma(share, v_red, s_red), fma(share, v_green, s_green)
            s_blue, s_depth = fma(share, v_blue, s_blue), fma(share, v_depth, s_depth)
            s_ax = s_ax + magnitude(fma(gx, slope_a, gy * slope_b))
            s_ay = s_ay + magnitude(fma(gx, slope_b, gy * slope_c))
        if touched:
            row = sums[i]
            row[0] += total(s_g)
            row[1] += total(s_x)
            row[2] += total(s_y)
            row[3] += total(s_xx)
            row[4] += total(s_xy)
            row[5] += total(s_yy)
            row[6] += total(s_red)
            row[7] += total(s_green)
            row[8] += total(s_blue)
            row[9] += total(s_depth)
            row[10] += total(s_ax)
            row[11] += total(s_ay)


@njit(cache=True, parallel=True)
def draw_backward(
    starts, rows, records, width, height, background, threads, in_x, in_y, finals, lasts, v_image, v_alpha, v_depth, partial
):  # fmt: skip
    """Sum the gradients of each Gaussian over its pixels into partial [threads,N,16], each thread its own."""
    across = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    for thread in prange(threads):
        partial[thread] = ZERO
        state, deepest = np.empty(6 * AREA, np.float32), np.empty(BLOCKS, np.int32)
        for tile in range(thread, tiles, threads):
            if starts[tile] == starts[tile + 1]:
                continue
            left, top = tile % across * TILE, tile // across * TILE
            state[:] = ZERO
            state[:AREA] = finals[tile]
            for y in range(top, min(top + TILE, height)):
                for x in range(left, min(left + TILE, width)):
                    at = (((y - top) >> 2) * ACROSS + ((x - left) >> 2)) * LANES + ((y & 3) << 2) + (x & 3)
                    red, green, blue = v_image[y, x, 0], v_image[y, x, 1], v_image[y, x, 2]
                    behind = red * background[0] + green * background[1] + blue * background[2] - v_alpha[y, x]
                    state[AREA + at] = finals[tile, at] * behind
                    state[2 * AREA + at], state[3 * AREA + at], state[4 * AREA + at] = red, green, blue
                    state[5 * AREA + at] = v_depth[y, x]
            _tile_backward(
                tile, starts, rows, records, left, top, state, lasts[tile], deepest, in_x, in_y, partial[thread]
            )

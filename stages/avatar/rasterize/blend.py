"""The blend on a CPU: tile by tile (32x32 px), Gaussian by Gaussian, block by block (4x4 px), one lane a pixel.

A 64-bit word says which of a tile's 64 blocks a Gaussian reaches; most reach one or two, and only those are computed.
Exponents are in log2. Front to back, the transmittance T of a finished pixel turns negative, and its place in the list
is noted once. Back to front, one number S a pixel stands for all that lies behind, and only moments of
g = alpha dL/dalpha are summed for each Gaussian.
"""

from __future__ import annotations

import math

import numpy as np

from stages.avatar.kernels import njit, prange
from stages.avatar.kernels.lanes import (
    LANES,
    any_lane,
    at_most,
    count_trailing_zeros,
    differ,
    exp2,
    fma,
    lesser,
    magnitude,
    select,
    select_index,
    spread,
    totals,
)
from stages.avatar.kernels.memory import load, load_index, peek, prefetch, store, store_index
from stages.avatar.rasterize.projection import BLUE, DEPTH, GREEN, LOG2E, LOG_OPACITY, QA, QC, RED, ROW, SLOPE, X, Y
from stages.avatar.rasterize.rendering import ALPHA_MAX, ALPHA_MIN
from stages.avatar.rasterize.tiles import ACROSS, AHEAD, BLOCK, TILE

BLOCKS = ACROSS * ACROSS
AREA = BLOCKS * LANES
FAINTEST = np.float32(math.log2(ALPHA_MIN))
LARGEST = np.float32(ALPHA_MAX)
IN_X = np.tile(np.arange(BLOCK, dtype=np.float32) + np.float32(0.5), BLOCK)
IN_Y = np.repeat(np.arange(BLOCK, dtype=np.float32) + np.float32(0.5), BLOCK)
ZERO, ONE = np.float32(0), np.float32(1)
NEVER, NOWHERE = np.int32(2**31 - 1), np.int32(-1)  # where a pixel ended: not at all; outside of the picture
ALL = np.uint64(2**64 - 1)  # blocks of a tile
TWICE = np.float32(2 / LOG2E)


@njit(cache=True)
def _lines(numbers):
    """Uninitialised float32 [numbers] that begin on a cache line: a vector that lies on two takes twice as long."""
    raw = np.empty(numbers + LANES, np.float32)
    start = -(raw.ctypes.data // 4) % LANES
    return raw[start : start + numbers]


@njit(cache=True)
def _draw_tile(start, end, rows, masks, records, left, top, inside, wanted, stop, state, stops, in_x, in_y):
    """Blend the `wanted` blocks of one tile front to back into state [5,1024] (T, red, green, blue, depth) and stops [1024].

    `left` and `top` are px of the whole picture; `inside` = (width, height) px is the part of the tile that is drawn.
    A pixel ends when less than `stop` of the light would pass.
    """
    live = np.uint64(0)
    for block in range(BLOCKS):
        x, y = BLOCK * (block % ACROSS), BLOCK * (block // ACROSS)
        if x < inside[0] and y < inside[1]:
            live |= np.uint64(1) << np.uint64(block)
        for lane in range(LANES):
            drawn = x + lane % BLOCK < inside[0] and y + lane // BLOCK < inside[1]
            state[block * LANES + lane] = ONE if drawn else -ONE
            stops[block * LANES + lane] = NEVER if drawn else NOWHERE
    live &= wanted
    state[AREA:] = ZERO
    inner_x, inner_y = load(in_x, 0), load(in_y, 0)
    for k in range(start, end):
        bits = peek(masks, k) & live
        if bits == np.uint64(0):
            continue
        prefetch(records, np.int64(peek(rows, k + AHEAD)) * ROW)
        r = np.int64(peek(rows, k)) * ROW
        qa, slant, qc, log_opacity = (
            peek(records, r + QA),
            peek(records, r + SLOPE),
            peek(records, r + QC),
            peek(records, r + LOG_OPACITY),
        )
        red, green, blue = peek(records, r + RED), peek(records, r + GREEN), peek(records, r + BLUE)
        depth = peek(records, r + DEPTH)
        to_x, to_y = np.float32(left) - peek(records, r + X), np.float32(top) - peek(records, r + Y)
        while bits != np.uint64(0):
            block = count_trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            at = block * LANES
            dx = inner_x + (to_x + np.float32(BLOCK * (block & (ACROSS - 1))))
            dy = inner_y + (to_y + np.float32(BLOCK * (block >> 3)))
            u = fma(dy, slant, dx)
            power = fma(u * u, qa, fma(dy * dy, qc, log_opacity))
            seen = power >= FAINTEST
            if not any_lane(seen):
                continue
            alpha = select(seen, lesser(exp2(power), LARGEST), ZERO)
            light = load(state, at)
            share = alpha * light
            passed = light - share
            counts = passed > stop
            share = select(counts, share, ZERO)
            store(state, at, select(counts, passed, -magnitude(light)))
            store(state, AREA + at, fma(share, red, load(state, AREA + at)))
            store(state, 2 * AREA + at, fma(share, green, load(state, 2 * AREA + at)))
            store(state, 3 * AREA + at, fma(share, blue, load(state, 3 * AREA + at)))
            store(state, 4 * AREA + at, fma(share, depth, load(state, 4 * AREA + at)))
            if differ(counts, light > ZERO):  # a pixel ends here
                ends = (light > ZERO) & (passed <= stop)
                store_index(stops, at, select_index(ends, k, load_index(stops, at)))
                if not any_lane(counts):
                    live &= ~(np.uint64(1) << np.uint64(block))
        if live == np.uint64(0):
            break


@njit(cache=True, parallel=True)
def draw(
    starts, rows, masks, records, window, background, threads, in_x, in_y, wanted, stop, image, alpha, depth, finals, stops
):  # fmt: skip
    """Blend the blocks that are `wanted` [tiles], one a bit, of a window (left, top, right, bottom) px of the picture.

    Fills image [H,W,3] over background [3], alpha and depth [H,W] of the window; finals (T) and stops [tiles,1024].
    """
    width, height = window[2] - window[0], window[3] - window[1]
    across = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    for thread in prange(threads):
        state = _lines(5 * AREA)
        for tile in range(thread, tiles, threads):
            if wanted[tile] == np.uint64(0):
                continue
            left, top = tile % across * TILE, tile // across * TILE
            inside = min(width - left, TILE), min(height - top, TILE)
            _draw_tile(
                starts[tile],
                starts[tile + 1],
                rows,
                masks,
                records,
                window[0] + left,
                window[1] + top,
                inside,
                wanted[tile],
                stop,
                state,
                stops[tile],
                in_x,
                in_y,
            )
            for at in range(AREA):
                finals[tile, at] = abs(state[at])
            bits = wanted[tile]
            while bits != np.uint64(0):
                block = count_trailing_zeros(bits)
                bits &= bits - np.uint64(1)
                x, y = BLOCK * (block & (ACROSS - 1)), BLOCK * (block >> 3)
                for lane in range(LANES):
                    column, row = x + (lane & 3), y + (lane >> 2)
                    if column < inside[0] and row < inside[1]:
                        at = block * LANES + lane
                        light = finals[tile, at]
                        image[top + row, left + column, 0] = state[AREA + at] + light * background[0]
                        image[top + row, left + column, 1] = state[2 * AREA + at] + light * background[1]
                        image[top + row, left + column, 2] = state[3 * AREA + at] + light * background[2]
                        alpha[top + row, left + column] = ONE - light
                        depth[top + row, left + column] = state[4 * AREA + at]


@njit(cache=True)
def _tile_backward(start, end, rows, masks, records, left, top, state, stops, deepest, in_x, in_y, layer, sums):
    """Walk one tile back to front; state [6,1024] holds T, S and dL/d(red, green, blue, depth) of each pixel."""
    inner_x, inner_y = load(in_x, 0), load(in_y, 0)
    zero = spread(ZERO)
    last = start
    for block in range(BLOCKS):
        deepest[block] = stops[block * LANES : (block + 1) * LANES].max()
        last = max(last, min(end, deepest[block]))
    for k in range(last - 1, start - 1, -1):
        prefetch(sums, np.int64(peek(rows, max(k - AHEAD, 0))) * ROW)
        prefetch(records, np.int64(peek(rows, max(k - AHEAD, 0))) * ROW)
        bits = peek(masks, k)
        r = np.int64(peek(rows, k)) * ROW
        qa, slant, qc, log_opacity = (
            peek(records, r + QA),
            peek(records, r + SLOPE),
            peek(records, r + QC),
            peek(records, r + LOG_OPACITY),
        )
        red, green, blue = peek(records, r + RED), peek(records, r + GREEN), peek(records, r + BLUE)
        depth = peek(records, r + DEPTH)
        to_x, to_y = np.float32(left) - peek(records, r + X), np.float32(top) - peek(records, r + Y)
        slope_u, slope_y = TWICE * qa, TWICE * qc
        slope_uy = slope_u * slant
        touched = False
        s_g, s_u, s_y, s_uu, s_uy, s_yy = zero, zero, zero, zero, zero, zero
        s_red, s_green, s_blue, s_depth, s_ax, s_ay = zero, zero, zero, zero, zero, zero
        while bits != np.uint64(0):
            block = count_trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            if peek(deepest, block) <= k:
                continue
            at = block * LANES
            dx = inner_x + (to_x + np.float32(BLOCK * (block & (ACROSS - 1))))
            dy = inner_y + (to_y + np.float32(BLOCK * (block >> 3)))
            u = fma(dy, slant, dx)
            power = fma(u * u, qa, fma(dy * dy, qc, log_opacity))
            seen = (power >= FAINTEST) & at_most(k + 1, load_index(stops, at))
            if not any_lane(seen):
                continue
            touched = True
            full = exp2(power)
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
            g = select(full <= LARGEST, alpha * slope, ZERO)
            gu, gy = g * u, g * dy
            s_g, s_u, s_y = s_g + g, s_u + gu, s_y + gy
            s_uu, s_uy, s_yy = fma(gu, u, s_uu), fma(gu, dy, s_uy), fma(gy, dy, s_yy)
            s_red, s_green = fma(share, v_red, s_red), fma(share, v_green, s_green)
            s_blue, s_depth = fma(share, v_blue, s_blue), fma(share, v_depth, s_depth)
            s_ax = s_ax + magnitude(gu * slope_u)
            s_ay = s_ay + magnitude(fma(gu, slope_uy, gy * slope_y))
        if touched:
            ax0, ay0, ax1, ay1, ax2, ay2 = s_ax, s_ay, zero, zero, zero, zero
            if layer == 1:
                ax0, ay0, ax1, ay1 = zero, zero, s_ax, s_ay
            elif layer == 2:
                ax0, ay0, ax2, ay2 = zero, zero, s_ax, s_ay
            moments = (s_g, s_u, s_y, s_uu, s_uy, s_yy, s_red, s_green, s_blue, s_depth, ax0, ay0, ax1, ay1, ax2, ay2)
            store(sums, r, load(sums, r) + totals(moments))


@njit(cache=True, parallel=True)
def draw_backward(
    starts, rows, masks, records, window, background, threads, in_x, in_y, finals, stops, v_image, v_alpha, v_depth, layer, sums
):  # fmt: skip
    """Add the gradients of each Gaussian over its pixels to sums [threads,N*16], each thread its own."""
    width, height = window[2] - window[0], window[3] - window[1]
    across = (width + TILE - 1) // TILE
    tiles = len(starts) - 1
    for thread in prange(threads):
        state, deepest = _lines(6 * AREA), np.empty(BLOCKS, np.int32)
        for tile in range(thread, tiles, threads):
            if starts[tile] == starts[tile + 1]:
                continue
            left, top = tile % across * TILE, tile // across * TILE
            state[:] = ZERO
            state[:AREA] = finals[tile]
            for y in range(min(height - top, TILE)):
                for x in range(min(width - left, TILE)):
                    at = ((y >> 2) * ACROSS + (x >> 2)) * LANES + ((y & 3) << 2) + (x & 3)
                    red, green, blue = (
                        v_image[top + y, left + x, 0],
                        v_image[top + y, left + x, 1],
                        v_image[top + y, left + x, 2],
                    )
                    behind = red * background[0] + green * background[1] + blue * background[2]
                    state[AREA + at] = finals[tile, at] * (behind - v_alpha[top + y, left + x])
                    state[2 * AREA + at], state[3 * AREA + at], state[4 * AREA + at] = red, green, blue
                    state[5 * AREA + at] = v_depth[top + y, left + x]
            _tile_backward(
                starts[tile],
                starts[tile + 1],
                rows,
                masks,
                records,
                window[0] + left,
                window[1] + top,
                state,
                stops[tile],
                deepest,
                in_x,
                in_y,
                layer,
                sums[thread],
            )

"""Structural similarity (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5, zeros beyond the border, as 3DGS takes it.

Pictures are shifted by the target's mean before variances are formed, so a flat picture has a variance of exactly 0
(hard case G01); the window's weight inside the picture undoes the shift near the border.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.avatar.kernels import njit, prange
from stages.avatar.kernels.lanes import LANES, fma, spread
from stages.avatar.kernels.memory import load, store

RADIUS = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
_OFFSETS = np.arange(-RADIUS, RADIUS + 1)
WINDOW = np.exp(-(_OFFSETS**2) / (2 * SIGMA**2))
WINDOW = (WINDOW / WINDOW.sum()).astype(np.float32)
STRIP = 16  # rows worked on at a time
ZERO, ONE, TWO, LEAST_1, LEAST_2 = (np.float32(n) for n in (0, 1, 2, C1, C2))


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM over pixels and channels of pictures [H,W,3] in [0,1]; differentiable in `image` only.

    1 for equal pictures. Float32 on a CPU goes to a fused kernel, everything else to `ssim_reference`.
    """
    if image.dtype == torch.float32 and image.device.type == "cpu":
        return _Ssim.apply(image, target)
    return ssim_reference(image, target)


def ssim_reference(image: Tensor, target: Tensor) -> Tensor:
    """The specification of `ssim` in plain torch, any dtype and device.

    Blurs are products with banded matrices: as convolutions they took half of a training step's time on a GPU.
    """
    target = target.detach()
    mean = target.mean((0, 1))
    x, y = ((picture - mean).permute(2, 0, 1) for picture in (image, target))
    down, along = (_band(size, image.dtype, image.device) for size in image.shape[:2])
    bx, by, squares, product = (down @ torch.stack([x, y, x * x + y * y, x * y]) @ along).unbind()
    inside, mean = down.sum(1)[:, None] * along.sum(0), mean[:, None, None]
    shift = mean * inside
    mx, my = bx + shift, by + shift
    # E[ab] - E[a] E[b] with a = x + mean, b = y + mean; beyond the border both are zero, hence `spill`
    spill = mean * (1 - inside) * (mx + by)
    both = squares - bx * bx - by * by + 2 * spill
    common = product - bx * by + spill
    return ((2 * mx * my + C1) * (2 * common + C2) / ((mx * mx + my * my + C1) * (both + C2))).mean()


def _band(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The symmetric matrix [size,size] that blurs a column of so many pixels."""
    return _large_band(max(64, 1 << (size - 1).bit_length()), dtype, device)[:size, :size]


@lru_cache(maxsize=4)
def _large_band(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    away = torch.arange(size)[:, None] - torch.arange(size)
    rows = torch.as_tensor(WINDOW)[away.clamp(-RADIUS, RADIUS) + RADIUS]
    return torch.where(away.abs() <= RADIUS, rows, 0).to(device, dtype)


@njit(cache=True, inline="always")
def _down(source, at, pitch, low, high, window):
    """16 px blurred along their columns; `low` to `high` - 1 are the rows around the one at `at` that exist."""
    total = spread(ZERO)
    for k in range(low, high):
        total = fma(load(source, at + k * pitch), window[k + RADIUS], total)
    return total


@njit(cache=True, inline="always")
def _along(row, at, window):
    """16 px blurred along `row`, which has RADIUS zeros before its first pixel and after its last."""
    total = spread(ZERO)
    for k in range(2 * RADIUS + 1):
        total = fma(load(row, at + k), window[k], total)
    return total


@njit(cache=True, inline="always")
def _centred(image, mean, y, c, row):
    """Channel c of the picture's row y, less `mean`, into row [P], whose end is left as it is."""
    for x in range(image.shape[1]):
        row[x] = image[y, x, c] - mean


@njit(cache=True, parallel=True)
def _forward(image, target, mean, inside_x, inside_y, drawn, window, parts, values):
    """Row sums of SSIM into values [3,H].

    Fills parts [3,3,H,P] = dS/d(bx), dS/d(blur x^2), dS/d(blur xy); P is the width made a multiple of 16, beyond the
    picture all is 0. `inside_x` [P], `inside_y` [H] are the window's weight inside the picture, `drawn` [P] is 1 inside
    and 0 beyond. The work goes by strips of rows, whose five planes (x, y, x^2, y^2, xy) stay in the processor's cache.
    """
    height = len(image)
    pitch, strips = len(drawn), (height + STRIP - 1) // STRIP
    plane, span = (STRIP + 2 * RADIUS) * pitch, pitch + 2 * RADIUS
    for job in prange(3 * strips):
        c, begin, end = job % 3, job // 3 * STRIP, min(job // 3 * STRIP + STRIP, height)
        first, last = max(begin - RADIUS, 0), min(end + RADIUS, height)
        planes, rows, lanes = (
            np.empty(5 * plane, np.float32),
            np.zeros(5 * span, np.float32),
            np.empty(LANES, np.float32),
        )
        one, other = np.zeros(pitch, np.float32), np.zeros(pitch, np.float32)
        for y in range(first, last):
            _centred(image, mean[c], y, c, one)
            _centred(target, mean[c], y, c, other)
            for x in range(0, pitch, LANES):
                at = (y - first) * pitch + x
                a, b = load(one, x), load(other, x)
                store(planes, at, a)
                store(planes, at + plane, b)
                store(planes, at + 2 * plane, a * a)
                store(planes, at + 3 * plane, b * b)
                store(planes, at + 4 * plane, a * b)
        for y in range(begin, end):
            low, high = max(-RADIUS, -y), min(RADIUS + 1, height - y)
            for p in range(5):
                for x in range(0, pitch, LANES):
                    at = p * plane + (y - first) * pitch + x
                    store(rows, p * span + RADIUS + x, _down(planes, at, pitch, low, high, window))
            total = spread(ZERO)
            for x in range(0, pitch, LANES):
                bx, by = _along(rows, x, window), _along(rows, span + x, window)
                xx, yy = _along(rows, 2 * span + x, window), _along(rows, 3 * span + x, window)
                xy = _along(rows, 4 * span + x, window)
                inside, shown = load(inside_x, x) * inside_y[y], load(drawn, x)
                shift, spill = inside * mean[c], (ONE - inside) * mean[c]
                mx, my = bx + shift, by + shift
                rest = shift * spill
                vx = xx - bx * bx + TWO * bx * spill + rest
                vy = yy - by * by + TWO * by * spill + rest
                vxy = xy - bx * by + (bx + by) * spill + rest
                up_m, up_v = TWO * mx * my + LEAST_1, TWO * vxy + LEAST_2
                low_m, low_v = mx * mx + my * my + LEAST_1, vx + vy + LEAST_2
                inverse = shown / (low_m * low_v)
                value = up_m * up_v * inverse
                total = total + value
                d_v, d_vxy = -value / low_v, TWO * up_m * inverse
                d_mean = TWO * my * up_v * inverse - TWO * mx * value / low_m
                at = (3 * c * height + y) * pitch + x
                store(parts, at, d_mean + d_v * TWO * (spill - bx) + d_vxy * (spill - by))
                store(parts, at + height * pitch, d_v)
                store(parts, at + 2 * height * pitch, d_vxy)
            store(lanes, 0, total)
            values[c, y] = lanes.astype(np.float64).sum()


@njit(cache=True, parallel=True)
def _backward(image, target, mean, parts, window, scale, grad):
    """dL/d(image) [H,W,3] from the parts that `_forward` filled, times `scale`."""
    height, width, _ = grad.shape
    pitch, strips = len(parts) // (9 * height), (height + STRIP - 1) // STRIP
    plane, span = height * pitch, pitch + 2 * RADIUS
    for job in prange(3 * strips):
        c = job % 3
        rows, slopes = np.zeros(3 * span, np.float32), np.empty(pitch, np.float32)
        one, other = np.zeros(pitch, np.float32), np.zeros(pitch, np.float32)
        for y in range(job // 3 * STRIP, min(job // 3 * STRIP + STRIP, height)):
            low, high = max(-RADIUS, -y), min(RADIUS + 1, height - y)
            _centred(image, mean[c], y, c, one)
            _centred(target, mean[c], y, c, other)
            for p in range(3):
                for x in range(0, pitch, LANES):
                    at = (3 * c + p) * plane + y * pitch + x
                    store(rows, p * span + RADIUS + x, _down(parts, at, pitch, low, high, window))
            for x in range(0, pitch, LANES):
                slope = _along(rows, x, window) + TWO * load(one, x) * _along(rows, span + x, window)
                store(slopes, x, scale * (slope + load(other, x) * _along(rows, 2 * span + x, window)))
            for x in range(width):
                grad[y, x, c] = slopes[x]


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        a, b = (np.ascontiguousarray(t.detach().numpy()) for t in (image, target))
        height, width, _ = a.shape
        pitch = -(-width // LANES) * LANES
        mean = target.mean((0, 1)).numpy()
        inside = [np.convolve(np.ones(n, np.float32), WINDOW)[RADIUS:-RADIUS] for n in (width, height)]
        drawn = np.zeros(pitch, np.float32)
        drawn[:width] = 1
        inside[0] = np.pad(inside[0], (0, pitch - width))
        parts, values = np.empty(9 * height * pitch, np.float32), np.empty((3, height))
        _forward(a, b, mean, *inside, drawn, WINDOW, parts, values)
        ctx.kept = a, b, mean, parts
        return torch.tensor(values.sum() / a.size, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        grad = np.empty_like(ctx.kept[0])
        _backward(*ctx.kept, WINDOW, np.float32(upstream.item() / grad.size), grad)
        return torch.from_numpy(grad), None

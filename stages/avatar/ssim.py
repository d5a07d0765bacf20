"""Structural similarity (Wang et al. 2004): 11x11 Gaussian window, sigma 1.5, zeros beyond the border, as 3DGS takes it.

Pictures are shifted by the target's mean before variances are formed, so a flat picture has a variance of exactly 0
(hard case G01); the window's weight inside the picture undoes the shift near the border.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from stages.avatar import rasterize  # noqa: F401  (first: it names the folder of the compiled kernels)

RADIUS = 5
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
_OFFSETS = np.arange(-RADIUS, RADIUS + 1)
WINDOW = np.exp(-(_OFFSETS**2) / (2 * SIGMA**2))
WINDOW = (WINDOW / WINDOW.sum()).astype(np.float32)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM over pixels and channels of pictures [H,W,3] in [0,1]; differentiable in `image` only.

    1 for equal pictures. Float32 on a CPU goes to a fused kernel, everything else to `ssim_reference`.
    """
    if image.dtype == torch.float32 and image.device.type == "cpu":
        return _Ssim.apply(image, target)
    return ssim_reference(image, target)


def ssim_reference(image: Tensor, target: Tensor) -> Tensor:
    """The specification of `ssim` in plain torch, any dtype."""
    window = torch.as_tensor(WINDOW).to(image)
    kernel = (window[:, None] * window)[None, None]

    def blur(x: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(x.permute(2, 0, 1)[:, None], kernel, padding=RADIUS)

    target = target.detach()
    mean = target.mean((0, 1))
    inside = blur(torch.ones_like(target))
    x, y = image - mean, target - mean
    bx, by = blur(x), blur(y)
    shift = mean[:, None, None, None] * inside
    mx, my = bx + shift, by + shift
    # E[a^2] - E[a]^2 with a = x + mean; beyond the border both are zero, hence `inside`
    spill = mean[:, None, None, None] * (1 - inside)
    vx = blur(x * x) - bx * bx + 2 * bx * spill + shift * spill
    vy = blur(y * y) - by * by + 2 * by * spill + shift * spill
    vxy = blur(x * y) - bx * by + (bx + by) * spill + shift * spill
    return ((2 * mx * my + C1) * (2 * vxy + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))).mean()


@njit(cache=True, inline="always")
def _blur_rows(source, window, planes, y, height, width, column):
    """column[plane, x] = the window down the rows around y of source[plane]."""
    for p in range(planes):
        for x in range(width):
            column[p, x + RADIUS] = 0
        for k in range(max(0, y - RADIUS), min(height, y + RADIUS + 1)):
            w = window[k - y + RADIUS]
            for x in range(width):
                column[p, x + RADIUS] += w * source[p, k, x]


@njit(cache=True, inline="always")
def _blur_columns(column, window, planes, width, row):
    """row[plane, x] = the window along x of column[plane], which has a margin of zeros on both sides."""
    for p in range(planes):
        for x in range(width):
            row[p, x] = 0
        for k in range(2 * RADIUS + 1):
            w = window[k]
            for x in range(width):
                row[p, x] += w * column[p, x + k]


@njit(cache=True, parallel=True, fastmath={"reassoc", "contract"})
def _forward(image, target, mean, inside_x, inside_y, window, values, parts):
    """Row sums of SSIM into values [3,H]; parts [3,3,H,W] = dS/d(bx), dS/d(blur x^2), dS/d(blur xy) at each pixel."""
    height, width, _ = image.shape
    planes = np.empty((3, 5, height, width), np.float32)
    for job in prange(3 * height):
        c, y = job // height, job % height
        for x in range(width):
            a, b = image[y, x, c] - mean[c], target[y, x, c] - mean[c]
            planes[c, 0, y, x], planes[c, 1, y, x] = a, b
            planes[c, 2, y, x], planes[c, 3, y, x], planes[c, 4, y, x] = a * a, b * b, a * b
    for job in prange(3 * height):
        c, y = job // height, job % height
        column = np.zeros((5, width + 2 * RADIUS), np.float32)
        row = np.empty((5, width), np.float32)
        _blur_rows(planes[c], window, 5, y, height, width, column)
        _blur_columns(column, window, 5, width, row)
        total = 0.0
        for x in range(width):
            inside = inside_x[x] * inside_y[y]
            bx, by = row[0, x], row[1, x]
            shift, spill = mean[c] * inside, mean[c] * (np.float32(1) - inside)
            mx, my = bx + shift, by + shift
            vx = row[2, x] - bx * bx + np.float32(2) * bx * spill + shift * spill
            vy = row[3, x] - by * by + np.float32(2) * by * spill + shift * spill
            vxy = row[4, x] - bx * by + (bx + by) * spill + shift * spill
            up_m, up_v = np.float32(2) * mx * my + np.float32(C1), np.float32(2) * vxy + np.float32(C2)
            low_m, low_v = mx * mx + my * my + np.float32(C1), vx + vy + np.float32(C2)
            value = up_m * up_v / (low_m * low_v)
            total += value
            d_v = -value / low_v
            d_vxy = np.float32(2) * up_m / (low_m * low_v)
            parts[c, 0, y, x] = (
                np.float32(2) * my * up_v / (low_m * low_v)
                - np.float32(2) * mx * value / low_m
                + d_v * np.float32(2) * (spill - bx)
                + d_vxy * (spill - by)
            )
            parts[c, 1, y, x] = d_v
            parts[c, 2, y, x] = d_vxy
        values[c, y] = total


@njit(cache=True, parallel=True, fastmath={"reassoc", "contract"})
def _backward(image, target, mean, window, parts, scale, grad):
    height, width, _ = image.shape
    for job in prange(3 * height):
        c, y = job // height, job % height
        column = np.zeros((3, width + 2 * RADIUS), np.float32)
        row = np.empty((3, width), np.float32)
        _blur_rows(parts[c], window, 3, y, height, width, column)
        _blur_columns(column, window, 3, width, row)
        for x in range(width):
            a, b = image[y, x, c] - mean[c], target[y, x, c] - mean[c]
            grad[y, x, c] = scale * (row[0, x] + np.float32(2) * a * row[1, x] + b * row[2, x])


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target):
        a, b = (np.ascontiguousarray(t.detach().numpy()) for t in (image, target))
        height, width, _ = a.shape
        mean = b.mean((0, 1), dtype=np.float64).astype(np.float32)
        inside = [np.convolve(np.ones(n, np.float32), WINDOW)[RADIUS:-RADIUS] for n in (width, height)]
        values, parts = np.empty((3, height)), np.empty((3, 3, height, width), np.float32)
        _forward(a, b, mean, *inside, WINDOW, values, parts)
        ctx.kept = a, b, mean, parts
        return torch.tensor(values.sum() / a.size, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, upstream):
        a, b, mean, parts = ctx.kept
        grad = np.empty_like(a)
        _backward(a, b, mean, WINDOW, parts, np.float32(upstream.item() / a.size), grad)
        return torch.from_numpy(grad), None

"""The naive CPU rasterizer, to compare with: what one would write first, in Numba.

A thread a tile of 16x16 px, a loop over its pixels, `exp` of the maths library, a buffer of gradients a thread, float32.
Projection, depth order and tile lists come from plain torch and are made beforehand.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from stages.avatar.rasterize import Camera, reference
from stages.avatar.rasterize.rendering import ALPHA_MAX, ALPHA_MIN, BLUR, FRUSTUM_MARGIN, T_STOP

TILE = 16
HALF, ZERO, ONE = np.float32(0.5), np.float32(0), np.float32(1)
FAINTEST, LARGEST, STOP = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX), np.float32(T_STOP)


class Workload(NamedTuple):
    """Gaussians (means [N,3], quats [N,4], scales [N,3], opacities [N], colors [N,3]), a camera, and dL/d image."""

    parts: tuple[Tensor, ...]
    camera: Camera
    v_image: Tensor


class Screen(NamedTuple):
    """Projected Gaussians and, for each tile, which rows to draw, nearest first; conics are inverse covariances a, b, c."""

    means2d: np.ndarray
    conics: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    starts: np.ndarray
    rows: np.ndarray


def covariances(work: Workload) -> tuple[Tensor, Tensor, Tensor]:
    """Depths [N], screen positions [N,2] px and covariances [N,3] (xx, xy, yy, blur included) in float64."""
    means, quats, scales = (part.double() for part in work.parts[:3])
    view, K = work.camera.viewmat.double(), work.camera.K.double()
    local = means @ view[:3, :3].T + view[:3, 3]
    turned = view[:3, :3] @ reference.gaussian_axes(quats, scales)
    z, focal, centre = local[:, 2], K.diagonal()[:2], K[:2, 2]
    size = torch.tensor([work.camera.width, work.camera.height]).double()
    at = local[:, :2] / z[:, None]
    margin = FRUSTUM_MARGIN * size
    towards = at.clamp((-centre - margin) / focal, (size - centre + margin) / focal)
    rays = (focal / z[:, None])[..., None] * (turned[:, :2] - towards[..., None] * turned[:, 2:])
    square = rays @ rays.mT
    spread = torch.stack([square[:, 0, 0] + BLUR, square[:, 0, 1], square[:, 1, 1] + BLUR], 1)
    return z, at * focal + centre, spread


def project(work: Workload, near: float = 0.01) -> Screen:
    """Everything before the blend."""
    z, at, spread = covariances(work)
    xx, xy, yy = spread.unbind(1)
    conics = torch.stack([yy, -xy, xx], 1) / (xx * yy - xy * xy)[:, None]
    cut = 2 * (work.parts[3].double() / ALPHA_MIN).log()
    reach = (cut.clamp_min(0)[:, None] * spread[:, [0, 2]]).sqrt()
    size = torch.tensor([work.camera.width, work.camera.height])
    seen = (z > near) & (cut >= 0) & (at + reach > 0).all(1) & (at - reach < size).all(1)
    order = z.float().argsort(stable=True)
    order = order[seen[order]].numpy()
    low, high = ((end / TILE).floor().nan_to_num(0, 0, 0).long() for end in (at - reach, at + reach))
    boxes = torch.cat([low.clamp_min(0), torch.minimum(high, (size - 1) // TILE)], 1).numpy()
    lists = _tile_lists(order, boxes, -(-work.camera.width // TILE), -(-work.camera.height // TILE))
    arrays = (at, conics, work.parts[3], work.parts[4])
    return Screen(*(a.detach().float().contiguous().numpy() for a in arrays), *lists)


@njit(cache=True)
def _tile_lists(order, boxes, across, down):
    starts = np.zeros(across * down + 1, np.int32)
    for i in order:
        for row in range(boxes[i, 1], boxes[i, 3] + 1):
            for column in range(boxes[i, 0], boxes[i, 2] + 1):
                starts[row * across + column + 1] += 1
    for tile in range(across * down):
        starts[tile + 1] += starts[tile]
    free, rows = starts.copy(), np.empty(starts[-1], np.int32)
    for i in order:
        for row in range(boxes[i, 1], boxes[i, 3] + 1):
            for column in range(boxes[i, 0], boxes[i, 2] + 1):
                rows[free[row * across + column]] = i
                free[row * across + column] += 1
    return starts, rows


@njit(cache=True, inline="always")
def _offset(means2d, conics, opacities, i, x, y):
    """Pixel centre minus mean (dx, dy), and opacity x falloff, not clamped."""
    dx, dy = np.float32(x) + HALF - means2d[i, 0], np.float32(y) + HALF - means2d[i, 1]
    power = HALF * (conics[i, 0] * dx * dx + conics[i, 2] * dy * dy) + conics[i, 1] * dx * dy
    return dx, dy, opacities[i] * math.exp(-max(power, ZERO))


@njit(cache=True, parallel=True)
def _forward(means2d, conics, opacities, colors, starts, rows, width, height, image, finals, lasts, pairs):
    """Blend pixel by pixel over black; pairs [H,W] counts the Gaussians that counted."""
    across = (width + TILE - 1) // TILE
    for tile in prange(len(starts) - 1):
        left, top = tile % across * TILE, tile // across * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                light, last, count = ONE, -1, 0
                red, green, blue = ZERO, ZERO, ZERO
                for k in range(starts[tile], starts[tile + 1]):
                    i = rows[k]
                    _, _, alpha = _offset(means2d, conics, opacities, i, x, y)
                    if alpha < FAINTEST:
                        continue
                    alpha = min(alpha, LARGEST)
                    if light * (ONE - alpha) <= STOP:
                        break
                    red += alpha * light * colors[i, 0]
                    green += alpha * light * colors[i, 1]
                    blue += alpha * light * colors[i, 2]
                    light *= ONE - alpha
                    last = k
                    count += 1
                image[y, x, 0], image[y, x, 1], image[y, x, 2] = red, green, blue
                finals[y, x], lasts[y, x], pairs[y, x] = light, last, count


@njit(cache=True, parallel=True)
def _backward(means2d, conics, opacities, colors, starts, rows, width, height, finals, lasts, v_image, threads, sums):
    """dL/d(mean x, y, conic a, b, c, opacity, red, green, blue) of each Gaussian into sums [threads,N,9]."""
    across = (width + TILE - 1) // TILE
    for thread in prange(threads):
        sums[thread] = ZERO
        for tile in range(thread, len(starts) - 1, threads):
            left, top = tile % across * TILE, tile // across * TILE
            for y in range(top, min(top + TILE, height)):
                for x in range(left, min(left + TILE, width)):
                    light, behind = finals[y, x], ZERO
                    v_red, v_green, v_blue = v_image[y, x, 0], v_image[y, x, 1], v_image[y, x, 2]
                    for k in range(lasts[y, x], starts[tile] - 1, -1):
                        i = rows[k]
                        dx, dy, full = _offset(means2d, conics, opacities, i, x, y)
                        if full < FAINTEST:
                            continue
                        s = sums[thread, i]
                        alpha = min(full, LARGEST)
                        light /= ONE - alpha
                        share = alpha * light
                        value = v_red * colors[i, 0] + v_green * colors[i, 1] + v_blue * colors[i, 2]
                        if full < LARGEST:
                            g = alpha * (value * light - behind / (ONE - alpha))
                            s[0] += g * (conics[i, 0] * dx + conics[i, 1] * dy)
                            s[1] += g * (conics[i, 1] * dx + conics[i, 2] * dy)
                            s[2] -= HALF * g * dx * dx
                            s[3] -= g * dx * dy
                            s[4] -= HALF * g * dy * dy
                            s[5] += g / opacities[i]
                        behind += value * share
                        s[6] += share * v_red
                        s[7] += share * v_green
                        s[8] += share * v_blue


class Naive:
    """The naive kernel on one workload."""

    def __init__(self, work: Workload, screen: Screen):
        size, n = (work.camera.height, work.camera.width), len(screen.means2d)
        self.inputs = (*screen, work.camera.width, work.camera.height)
        self.v_image, self.threads = work.v_image.numpy(), torch.get_num_threads()
        self.image = np.empty((*size, 3), np.float32)
        self.finals, self.lasts, self.pairs = (np.empty(size, t) for t in (np.float32, np.int32, np.int32))
        self.sums = np.empty((self.threads, n, 9), np.float32)

    def forward(self) -> np.ndarray:
        """The image [H,W,3]."""
        _forward(*self.inputs, self.image, self.finals, self.lasts, self.pairs)
        return self.image

    def backward(self) -> None:
        """Sum the gradients of `forward`'s image."""
        _backward(*self.inputs, self.finals, self.lasts, self.v_image, self.threads, self.sums)
        self.total = self.sums.sum(0)

    def gradients(self) -> tuple[np.ndarray, np.ndarray]:
        """Of means2d [N,2] and colors [N,3]."""
        return self.total[:, :2], self.total[:, 6:]

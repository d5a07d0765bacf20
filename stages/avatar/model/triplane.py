"""A field of features over three axis-aligned planes (HUGS section 3.1), in a box fitted to the body."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from stages.avatar.kernels import njit, prange

AXES = ((0, 1), (0, 2), (1, 2))  # along and across each plane
CHUNKS = 16  # ranges of points
PART = 16  # channels that one thread sums alone, so that the order of additions never changes


def features_reference(u: Tensor, table: Tensor, resolution: int) -> Tensor:
    """The specification of what a triplane reads: bilinear features [N,3C] of `table` [3 R^2,C] at `u`[N,3] in cells."""
    r = resolution
    cell = u.detach().floor().clamp(0, r - 2)
    f = u - cell
    cell = cell.long()
    corners, weights = [], []
    for plane, (a, b) in enumerate(AXES):
        first = (plane * r + cell[:, b]) * r + cell[:, a]
        corners.append(torch.stack([first, first + 1, first + r, first + r + 1], 1))
        fa, fb = f[:, a], f[:, b]
        ga, gb = 1 - fa, 1 - fb
        weights.append(torch.stack([ga * gb, fa * gb, ga * fb, fa * fb], 1))
    index = torch.stack(corners, 1).reshape(-1, 4)
    weight = torch.stack(weights, 1).reshape(-1, 4)
    return F.embedding_bag(index, table, per_sample_weights=weight, mode="sum").reshape(len(u), -1)


@njit(cache=True, inline="always")
def _cell(u, i, plane, r):
    """First of the four rows of a plane around point i, and how far beyond it the point is, along and across."""
    a, b = u[i, 0 if plane < 2 else 1], u[i, 1 if plane < 1 else 2]
    along, across = min(max(math.floor(a), 0), r - 2), min(max(math.floor(b), 0), r - 2)
    return (plane * r + across) * r + along, a - np.float32(along), b - np.float32(across)


@njit(cache=True, parallel=True, fastmath={"contract"})
def _read(u, table, r, out):
    n, channels = len(u), table.shape[1]
    for chunk in prange(CHUNKS):
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            for plane in range(3):
                row, a, b = _cell(u, i, plane, r)
                one = np.float32(1)
                w0, w1, w2, w3 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
                for c in range(channels):
                    low = w0 * table[row, c] + w1 * table[row + 1, c]
                    out[i, plane * channels + c] = low + w2 * table[row + r, c] + w3 * table[row + r + 1, c]


@njit(cache=True, parallel=True, fastmath={"contract", "reassoc"})
def _read_backward(u, table, r, grad, d_table, d_along, d_across):
    """Fill d_table, and slopes d_along, d_across [jobs,N] at the points; a job takes PART channels of one plane."""
    n, channels = len(u), table.shape[1]
    parts = (channels + PART - 1) // PART
    for job in prange(3 * parts):
        plane, low = job // parts, job % parts * PART
        high = min(low + PART, channels)
        d_table[plane * r * r : (plane + 1) * r * r, low:high] = 0
        for i in range(n):
            row, a, b = _cell(u, i, plane, r)
            one, along, across = np.float32(1), np.float32(0), np.float32(0)
            w0, w1, w2, w3 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
            for c in range(low, high):
                g = grad[i, plane * channels + c]
                t0, t1, t2, t3 = table[row, c], table[row + 1, c], table[row + r, c], table[row + r + 1, c]
                along += g * ((one - b) * (t1 - t0) + b * (t3 - t2))
                across += g * ((one - a) * (t2 - t0) + a * (t3 - t1))
                d_table[row, c] += w0 * g
                d_table[row + 1, c] += w1 * g
                d_table[row + r, c] += w2 * g
                d_table[row + r + 1, c] += w3 * g
            d_along[job, i], d_across[job, i] = along, across


class _Features(torch.autograd.Function):
    """`features_reference`, fused, for float32 on a CPU; the same to the bit for any number of threads."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, table: Tensor, resolution: int) -> Tensor:
        arrays = [np.ascontiguousarray(t.detach().numpy()) for t in (u, table)]
        out = np.empty((len(u), 3 * table.shape[1]), np.float32)
        _read(*arrays, resolution, out)
        ctx.kept = *arrays, resolution
        return torch.from_numpy(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor, None]:
        u, table, resolution = ctx.kept
        parts, n = -(-table.shape[1] // PART), len(u)
        d_table, (d_along, d_across) = np.empty_like(table), np.empty((2, 3 * parts, n), np.float32)
        grad = np.ascontiguousarray(upstream.numpy())
        _read_backward(u, table, resolution, grad, d_table, d_along, d_across)
        d_u = np.zeros((n, 3), np.float32)
        for job in range(3 * parts):
            a, b = AXES[job // parts]
            d_u[:, a] += d_along[job]
            d_u[:, b] += d_across[job]
        return torch.from_numpy(d_u), torch.from_numpy(d_table), None


class Triplane(nn.Module):
    """Three planes (xy, xz, yz) of `channels` x `resolution`^2 features over the box lower[3]..upper[3] in metres."""

    lower: Tensor
    upper: Tensor

    def __init__(self, lower: Tensor, upper: Tensor, channels: int, resolution: int, generator: torch.Generator):
        super().__init__()
        self.resolution = resolution
        self.register_buffer("lower", lower.clone())
        self.register_buffer("upper", upper.clone())
        table = torch.randn(3 * resolution * resolution, channels, generator=generator)
        self.table = nn.Parameter(table.to(lower))

    @property
    def width(self) -> int:
        """Features per point."""
        return 3 * self.table.shape[1]

    def forward(self, points: Tensor) -> Tensor:
        """Bilinear features [N, 3*channels] at canonical `points`[N,3] in metres.

        A point outside the box reads the nearest face and still has a gradient, so it can return. The outermost nodes
        lie on the faces of the box (align_corners). Raises ValueError for points or a table that are not finite: a
        weight of 0 hides no NaN.
        """
        if not points.isfinite().all():
            bad = int((~points.isfinite().all(1)).nonzero()[0])
            raise ValueError(f"canonical point {bad} is not finite: {points[bad].tolist()}")
        if not self.table.detach().sum().isfinite():
            self._name_bad_cell()
        r = self.resolution
        inside = points + (points.detach().clamp(self.lower, self.upper) - points.detach())
        u = (inside - self.lower) / (self.upper - self.lower) * (r - 1)
        fast = u.dtype == torch.float32 and u.device.type == "cpu"
        return (_Features.apply if fast else features_reference)(u, self.table, r)

    def _name_bad_cell(self) -> None:
        bad = (~self.table.isfinite().all(1)).nonzero()
        if len(bad):
            plane, cell = divmod(int(bad[0]), self.resolution**2)
            across, along = divmod(cell, self.resolution)
            name = "xyz"[AXES[plane][0]] + "xyz"[AXES[plane][1]]
            raise ValueError(
                f"plane {name} of the triplane is not finite in {len(bad)} cells, first ({along}, {across})"
            )

    def outside(self, points: Tensor) -> Tensor:
        """Mean squared distance in metres^2 of `points`[N,3] from the box: the pull that brings strays back."""
        return (points - points.detach().clamp(self.lower, self.upper)).square().sum(1).mean()

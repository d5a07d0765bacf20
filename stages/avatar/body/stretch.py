"""Cloth that bones draw wide: its Gaussians grow with it.

Skinning moves the axes of a Gaussian by the blend of its bones, which leaves them as small as at rest where legs draw a
skirt apart: one looks through between them. Places that are skinned do change by more than the blend, where weights
change from one to the next (the gradient of sum_k w_k(x) A_k x has a term for the gradient of each w_k). Neighbours tell it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.avatar.kernels import njit, prange
from stages.avatar.kernels.products import products
from stages.avatar.splats.neighbours import nearest

CLOTH = 0.5  # of a Gaussian's weight on bones of clothes, from which on it grows
NEIGHBOURS = 6
BELL = 1.5  # of the median distance to them: sigma of what a neighbour counts
STIFF = 0.6  # of that distance squared: where neighbours differ by less, as across cloth, they tell little
STEEPEST = 15.0  # shares of bones a metre: what is steeper is one piece of cloth beside another
ZERO = np.float32(0)


class Cloth(NamedTuple):
    """C Gaussians of cloth: their `rows`, those `near` each [C,M], the last itself, and `along` [C,M,3] in 1/m.

    The sum over M of f(near) x along is the gradient of f over the cloth.
    """

    rows: Tensor
    near: Tensor
    along: Tensor

    def slopes(self, weights: Tensor) -> Tensor:
        """How weights [N,J] change over the cloth: [C,J,3] in 1/m."""
        return weights[self.near].mT @ self.along


class Stretch(NamedTuple):
    """How the axes of N Gaussians change with their places: `axes` [N,3,3] m are what the blend of bones moves.

    Each axis of the C in `rows` gains a sum of the places of those `near` int32 [C,M], by `shares` [C,3,M] of each.
    """

    axes: Tensor
    rows: Tensor
    near: Tensor
    shares: Tensor

    def grown(self, means: Tensor, blend: Tensor) -> Tensor:
        """The axes [N,3,3] of Gaussians that bones took to means[N,3] by blend[N,3,3]."""
        return self.gained(products(blend, self.axes), means)

    def gained(self, axes: Tensor, means: Tensor) -> Tensor:
        """The axes [N,3,3], which may be overwritten, with what cloth gains of Gaussians that are at means[N,3]."""
        fast = means.dtype == torch.float32 and means.device.type == "cpu"
        add: Callable[..., Tensor] = _Gain.apply if fast else gain_reference
        return add(axes, means, self.rows, self.near, self.shares)


def gain_reference(axes: Tensor, means: Tensor, rows: Tensor, near: Tensor, shares: Tensor) -> Tensor:
    """The specification of what axes[N,3,3] gain, see `Stretch`, in plain torch; any dtype and device."""
    return axes.index_add(0, rows, (shares @ means[near]).mT)


class _Gain(torch.autograd.Function):
    """`gain_reference` of float32 on a CPU; writes into `axes`."""

    @staticmethod
    def forward(ctx: Any, axes: Tensor, means: Tensor, rows: Tensor, near: Tensor, shares: Tensor) -> Tensor:
        ctx.mark_dirty(axes)
        ctx.save_for_backward(means, rows, near, shares)
        _gain(*(part.detach().numpy() for part in (axes, means, rows, near, shares)))
        return axes

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        means, rows, near, shares = ctx.saved_tensors
        given = shares.mT @ upstream[rows].mT
        which = near.flatten().long()[:, None].expand(-1, 3)
        return upstream, torch.zeros_like(means).scatter_add_(0, which, given.flatten(0, 1)), None, None, None


@njit(cache=True, parallel=True, fastmath={"contract"})
def _gain(axes: np.ndarray, means: np.ndarray, rows: np.ndarray, near: np.ndarray, shares: np.ndarray) -> None:
    """Nine sums in registers: a loop over the axes would take twice as long."""
    for c in prange(len(rows)):
        ux = uy = uz = vx = vy = vz = wx = wy = wz = ZERO
        for m in range(near.shape[1]):
            at = np.uint32(near[c, m])  # unsigned: Numba need not look for negative ones
            x, y, z = means[at, 0], means[at, 1], means[at, 2]
            u, v, w = shares[c, 0, m], shares[c, 1, m], shares[c, 2, m]
            ux, uy, uz = ux + u * x, uy + u * y, uz + u * z
            vx, vy, vz = vx + v * x, vy + v * y, vz + v * z
            wx, wy, wz = wx + w * x, wy + w * y, wz + w * z
        axis = axes[rows[c]]
        axis[0, 0] += ux
        axis[1, 0] += uy
        axis[2, 0] += uz
        axis[0, 1] += vx
        axis[1, 1] += vy
        axis[2, 1] += vz
        axis[0, 2] += wx
        axis[1, 2] += wy
        axis[2, 2] += wz


@torch.no_grad()
def cloth_of(means: Tensor, weights: Tensor, bones: int) -> Cloth | None:
    """What is cloth of Gaussians at means[N,3] m at rest with weights[N,J], of which the first `bones` are the skeleton's."""
    rows = (weights[:, bones:].sum(1) > CLOTH).nonzero()[:, 0]
    if len(rows) < 2:
        return None
    points = means[rows]
    away, near = (found[:, 1:] for found in nearest(points, points, 1 + NEIGHBOURS))
    middle = away.to(means).median(1, keepdim=True).values.clamp_min(1e-3)
    steps = (points[near] - points[:, None]) / middle[..., None]
    counted = steps * torch.exp(-0.5 * (away.to(means) / (BELL * middle)).square())[..., None]
    spread = counted.mT @ steps + STIFF * torch.eye(3).to(means)
    along = torch.linalg.solve(spread, counted.mT).mT / middle[..., None]
    cloth = Cloth(rows, torch.cat([rows[near], rows[:, None]], 1), torch.cat([along, -along.sum(1, keepdim=True)], 1))
    steepness = cloth.slopes(weights).norm(dim=2).sum(1)
    return cloth._replace(along=cloth.along * (STEEPEST / steepness.clamp_min(STEEPEST))[:, None, None])


@torch.no_grad()
def stretch_of(cloth: Cloth, means: Tensor, axes: Tensor) -> Stretch:
    """How Gaussians at means[N,3] m with axes[N,3,3] m at rest stretch, which there are as they are."""
    rows, near, along = cloth
    shares = along @ axes[rows]
    still = means[near].mT @ shares  # what they gain where nothing has moved
    return Stretch(axes.index_add(0, rows, -still), rows, near.int(), shares.mT.contiguous())

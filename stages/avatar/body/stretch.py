"""Cloth that bones draw wide: its Gaussians grow with it.

Skinning moves the axes of a Gaussian by the blend of its bones, which leaves them as small as at rest where legs draw a
skirt apart: one looks through between them. Places that are skinned do change by more than the blend, where weights
change from one to the next (the gradient of sum_k w_k(x) A_k x has a term for the gradient of each w_k). Neighbours tell it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from stages.avatar.splats.neighbours import nearest

CLOTH = 0.5  # of a Gaussian's weight on bones of clothes, from which on it grows
NEIGHBOURS = 6
BELL = 1.5  # of the median distance to them: sigma of what a neighbour counts
STIFF = 0.6  # of that distance squared: where neighbours differ by less, as across cloth, they tell little
STEEPEST = 15.0  # shares of bones a metre: what is steeper is one piece of cloth beside another


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

    The C in `rows` gain sums of places: each axis by those `near` int32 [3C,M], `shares` [3C,M] of each.
    """

    axes: Tensor
    rows: Tensor
    near: Tensor
    shares: Tensor

    def grown(self, means: Tensor, blend: Tensor) -> Tensor:
        """The axes [N,3,3] of Gaussians that bones took to means[N,3] by blend[N,3,3]."""
        gained: Tensor = _Sums.apply(means, self.near, self.shares)
        return (blend @ self.axes).index_add_(0, self.rows, gained.unflatten(0, (-1, 3)).mT)


class _Sums(torch.autograd.Function):
    """Sums [3C,3] of means[N,3]: of those `near` [3C,M], thrice the same, by their `shares` [3C,M].

    Torch's own way back takes ten times as long.
    """

    @staticmethod
    def forward(ctx: Any, means: Tensor, near: Tensor, shares: Tensor) -> Tensor:
        ctx.save_for_backward(means, near, shares)
        return F.embedding_bag(near, means, mode="sum", per_sample_weights=shares)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        means, near, shares = ctx.saved_tensors
        given = (shares.unflatten(0, (-1, 3)).mT @ upstream.unflatten(0, (-1, 3))).flatten(0, 1)
        rows = near[::3].flatten().long()[:, None].expand_as(given)
        return torch.zeros_like(means).scatter_add_(0, rows, given), None, None


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
    return Stretch(
        axes=axes.index_add(0, rows, -still),
        rows=rows,
        near=near.int().repeat_interleave(3, 0),
        shares=shares.mT.flatten(0, 1).contiguous(),
    )

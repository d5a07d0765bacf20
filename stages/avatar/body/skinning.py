"""Linear blend skinning of points that are not mesh vertices, from the canonical pose to any other."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.splats.neighbours import nearest

WEIGHT_GAP = 0.0021
"""A neighbour counts if its weights are this close (sum of absolute differences) to the nearest vertex's: HUGS keeps
exp(-gap / (2 * 0.1**2)) > 0.9, so that a finger does not borrow from the thigh it touches."""


def skin(points: Tensor, weights: Tensor, bones: Tensor) -> tuple[Tensor, Tensor]:
    """Points [N,3] carried by bones [24,4,4] with weights [N,24]; also the blended linear parts T [N,3,3].

    T is not a rotation where bones disagree. A Gaussian with axes M (columns) becomes T M exactly, so nothing needs to
    be made orthonormal: covariance T M M^T T^T, valid for singular and mirrored T too.
    """
    blend = (weights @ bones[:, :3, :].flatten(1)).unflatten(1, (3, 4))
    linear = blend[..., :3]
    return (linear @ points[..., None])[..., 0] + blend[..., 3], linear


@torch.no_grad()
def knn_weights(points: Tensor, vertices: Tensor, vertex_weights: Tensor, k: int = 6) -> Tensor:
    """What the body's own skinning weights [V,24] say at `points` [N,3]: [N,24], rows sum to 1, no gradient.

    Averages, by exp(-d^2) (HUGS supplement), those of the k nearest `vertices` [V,3] m that move almost as the nearest
    does (WEIGHT_GAP). The exponents are shifted by their largest, so a point 20 m away gets weights too.
    Raises ValueError for points that are not finite, or fewer vertices than k.
    """
    if not 1 <= k <= len(vertices):
        raise ValueError(f"cannot take the {k} nearest of {len(vertices)} vertices")
    if not points.isfinite().all():
        row = int((~points.isfinite().all(-1)).nonzero()[0])
        raise ValueError(f"point {row} is not finite: {points[row].tolist()}")
    distances, near = nearest(vertices, points, k)
    around = vertex_weights.to(points)[near]
    gap = (around - around[:, :1]).abs().sum(-1)
    exponents = torch.where(gap < WEIGHT_GAP, -distances.square(), -torch.inf)
    share = exponents.softmax(-1).to(points)  # the nearest is always kept, so no row is empty
    blended = (share[..., None] * around).sum(1)
    return blended / blended.sum(-1, keepdim=True)

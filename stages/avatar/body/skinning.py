"""Linear blend skinning of points that are not mesh vertices, from the canonical pose to any other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from stages.avatar.kernels.products import turned
from stages.avatar.splats.neighbours import nearest

WEIGHT_GAP = 0.0021
"""A neighbour counts if its weights are this close (sum of absolute differences) to the nearest vertex's: HUGS keeps
exp(-gap / (2 * 0.1**2)) > 0.9, so that a finger does not borrow from the thigh it touches."""

BYTES, WORDS = 255, 65535  # what a row of weights adds up to
MOST = 8  # bones that move a vertex in glTF as programs read it: two sets of four


class FewBones(NamedTuple):
    """Weights of N points, each moved by at most M bones: which ones, int32 [N,M], and their shares [N,M]."""

    which: Tensor
    shares: Tensor


def skin(points: Tensor, weights: Tensor | FewBones, bones: Tensor) -> tuple[Tensor, Tensor]:
    """Points [N,3] carried by bones [J,4,4] with weights [N,J]; also the blended linear parts T [N,3,3].

    T is not a rotation where bones disagree. A Gaussian with axes M (columns) becomes T M exactly, so nothing needs to
    be made orthonormal: covariance T M M^T T^T, valid for singular and mirrored T too.
    """
    rows = bones[:, :3, :].flatten(1)
    if isinstance(weights, FewBones):
        blend = F.embedding_bag(weights.which, rows, mode="sum", per_sample_weights=weights.shares)
    else:
        blend = weights @ rows
    blend = blend.unflatten(1, (3, 4))
    linear = blend[..., :3].contiguous()  # once for all that is turned
    return turned(linear, points) + blend[..., 3], linear


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


def of_few_bones(weights: Tensor) -> Tensor:
    """Weights [N,J] with the MOST heaviest of each row alone, whose rows sum to 1 again."""
    heavy, chosen = weights.topk(min(MOST, weights.shape[1]), dim=1)
    return torch.zeros_like(weights).scatter_(1, chosen, heavy / heavy.sum(1, keepdim=True))


def without_zeros(weights: Tensor) -> FewBones | None:
    """Weights [N,J] of which no row has more than MOST that are not 0; else None.

    With them skinning takes as long with many bones as with few, but its gradient six times as long.
    """
    most = int((weights != 0).sum(1).amax()) if weights.numel() else 0
    if not 0 < most <= MOST:
        return None
    shares, which = weights.topk(most, dim=1)
    return FewBones(which.int(), shares)


def heaviest(weights: np.ndarray, count: int = 4, full: int = BYTES) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The `count` heaviest of weights[N,24]: bones uint8[N,count], whole weights that add up to `full`, their share [N].

    Rounded by largest remainder, since engines do not make them add up. A bone without weight is bone 0.
    """
    order = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    chosen = np.take_along_axis(weights, order, 1)
    kept = chosen.sum(1)
    exact = chosen / kept[:, None] * full
    whole = np.floor(exact).astype(np.int64)
    rank = np.argsort(np.argsort(whole - exact, axis=1, kind="stable"), axis=1)
    whole += rank < (full - whole.sum(1))[:, None]
    bones = np.where(whole > 0, order, 0)
    return bones.astype(np.uint8), whole.astype(np.uint8 if full == BYTES else np.uint16), kept.astype(np.float32)


def all_bones(bones: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Weights [N,count], rows summing to 1, of the bones and whole weights that `heaviest` gives."""
    found, shares = np.zeros((len(bones), count)), weights / weights.sum(1, keepdims=True)
    for column in range(bones.shape[1]):
        found[np.arange(len(bones)), bones[:, column]] += shares[:, column]
    return found

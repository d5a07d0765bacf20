"""Nearest points, points far from one another, and rows spread evenly over many."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

AT = 1e-3  # m: what is so far off counts half of what is at the place


@torch.no_grad()
def nearest(those: Tensor, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Distances float64[N,k] and rows int64[N,k] of the k of `those`[M,3] nearest to each of points[N,3], nearest first.

    With M < k there are M columns. No gradient; on a GPU the search is still done by the CPU.
    """
    columns = list(range(1, min(k, len(those)) + 1))
    found = cKDTree(those.cpu().numpy()).query(points.cpu().numpy(), k=columns, workers=-1)
    distances, rows = (torch.as_tensor(array, device=points.device) for array in found)
    return distances, rows


def shares_near(those: Tensor, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Rows int64[N,k] of the k of `those`[M,3] nearest to each of points[N,3], and shares [N,k], which add up to 1: the larger, the
    nearer.
    """
    away, rows = nearest(those, points, k)
    return rows, shares_of(away.to(points))


def shares_of(away: Tensor) -> Tensor:
    """Shares [N,k] of what is so many metres `away` [N,k]: they add up to 1, and are the larger, the nearer it is."""
    return normalize(1 / (away + AT), p=1, dim=1)


def mean_near(values: Tensor, those: Tensor, points: Tensor, k: int) -> Tensor:
    """For each of points[N,3] the mean [N,...] of values[M,...] of the k of `those`[M,3] nearest, by `shares_near`."""
    rows, shares = shares_near(those, points, k)
    return torch.einsum("nk,nk...->n...", shares, values[rows])


def median_near(values: Tensor, those: Tensor, points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """For each of points[N,3] the median [N,...] of values[M,...] of the k of `those`[M,3] nearest, and how far they are [N,k]."""
    away, rows = nearest(those, points, k)
    return values[rows].median(1).values, away


def spread_evenly(rows: list[int], most: int) -> list[int]:
    """At most `most` of `rows`, spread evenly, the first among them."""
    count = min(most, len(rows))
    return [rows[i * len(rows) // count] for i in range(count)]


def farthest_points(points: Tensor, count: int) -> Tensor:
    """Rows int64[count] of points[N,3] far from one another, each the farthest from those before; so is any prefix."""
    chosen = torch.zeros(min(count, len(points)), dtype=torch.long)
    away = points.new_full((len(points),), torch.inf)
    for i in range(1, len(chosen)):
        away = torch.minimum(away, (points - points[chosen[i - 1]]).square().sum(-1))
        chosen[i] = away.argmax()
    return chosen

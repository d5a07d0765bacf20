"""Which Gaussians say what is at a place of the surface."""

from __future__ import annotations

from torch import Tensor

from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import nearest

SOLID = 0.3  # opacity from which a Gaussian counts
AROUND = 12  # Gaussians that are asked
CLOSE = 0.005  # m: one so far off counts half of one at the place


def around(splats: Splats, places: Tensor) -> tuple[Tensor, Tensor]:
    """Rows [P,K] of the solid Gaussians around places [P,3] m, and their shares [P,K], which add up to 1. One at least is solid."""
    solid = (splats.opacities > SOLID).nonzero()[:, 0]
    away, near = nearest(splats.means[solid], places, AROUND)
    rows = solid[near]
    share = splats.opacities[rows] / (away.to(places) / CLOSE).square().add(1)
    return rows, share / share.sum(1, keepdim=True)

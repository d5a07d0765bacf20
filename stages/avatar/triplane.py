"""A field of features over three axis-aligned planes (HUGS section 3.1), in a box fitted to the body."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Triplane(nn.Module):
    """Three planes (xy, xz, yz) of `channels` x `resolution`^2 features over the box lower[3]..upper[3] in metres."""

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

        A point outside the box reads the nearest face and still has a gradient, so it can return. Points that are not
        finite raise ValueError before any table is read. Nodes lie on the faces of the box (align_corners).
        """
        if not points.isfinite().all():
            bad = int((~points.isfinite().all(1)).nonzero()[0])
            raise ValueError(f"canonical point {bad} is not finite: {points[bad].tolist()}")
        r = self.resolution
        inside = points + (points.detach().clamp(self.lower, self.upper) - points.detach())
        u = (inside - self.lower) / (self.upper - self.lower) * (r - 1)
        cell = u.detach().floor().clamp(0, r - 2)
        f = u - cell
        cell = cell.long()
        corners, weights = [], []
        for plane, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            first = (plane * r + cell[:, b]) * r + cell[:, a]
            corners.append(torch.stack([first, first + 1, first + r, first + r + 1], 1))
            fa, fb = f[:, a], f[:, b]
            ga, gb = 1 - fa, 1 - fb
            weights.append(torch.stack([ga * gb, fa * gb, ga * fb, fa * fb], 1))
        index = torch.stack(corners, 1).reshape(-1, 4)
        weight = torch.stack(weights, 1).reshape(-1, 4)
        features = F.embedding_bag(index, self.table, per_sample_weights=weight, mode="sum")
        return features.reshape(len(points), self.width)

    def outside(self, points: Tensor) -> Tensor:
        """Mean squared distance in metres^2 of `points`[N,3] from the box: the pull that brings strays back."""
        return (points - points.detach().clamp(self.lower, self.upper)).square().sum(1).mean()

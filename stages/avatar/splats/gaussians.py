"""Gaussians in the world, ready to be drawn, and helpers for sets of points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.splats.neighbours import nearest
from stages.avatar.splats.sh import sh_colors

SMALLEST = 1e-7  # of the extent; nearer neighbours are taken for duplicates


class Splats(NamedTuple):
    """N Gaussians in the world frame, metres, ready for any camera.

    means[N,3], axes[N,3,3] as in `Gaussians`, opacities[N], sh[N,K,3], and rotations[N,3,3] from the frame in which
    colours are stored, or None. `antialias` as in `Gaussians`: learned so, drawn so. `normals` [N,3], of any length, are those of
    the surface on which a person's Gaussians hang; None of a scene.
    """

    means: Tensor
    axes: Tensor
    opacities: Tensor
    sh: Tensor
    rotations: Tensor | None = None
    antialias: bool = False
    normals: Tensor | None = None

    def detach(self) -> Splats:
        """The same without gradients."""
        return self._each(Tensor.detach)

    def rows(self, kept: Tensor) -> Splats:
        """Those `kept` [N]."""
        return self._each(lambda part: part[kept])

    def _each(self, change: Callable[[Tensor], Tensor]) -> Splats:
        return Splats._make(change(part) if isinstance(part, Tensor) else part for part in self)

    def colors(self, eye: Tensor) -> Tensor:
        """Colours [N,3] seen from `eye`[3] in the world; a Gaussian at the centre itself gets degree 0."""
        if self.sh.shape[1] == 1:
            return sh_colors(self.sh, None)
        away = self.means - eye
        if self.rotations is not None:
            away = torch.einsum("nij,ni->nj", self.rotations, away)
        squared = away.square().sum(1, keepdim=True)
        return sh_colors(self.sh, away * squared.clamp_min(1e-12).rsqrt())


def together(sets: Sequence[Splats]) -> Splats | None:
    """Several sets of one degree of colour as one, their rows in this order; None for none."""
    if len(sets) < 2:
        return sets[0] if sets else None
    means, axes, opacities, sh = (torch.cat(parts) for parts in list(zip(*sets, strict=True))[:4])
    turns = [one.rotations for one in sets if one.rotations is not None]
    return Splats(means, axes, opacities, sh, torch.cat(turns) if turns else None, any(one.antialias for one in sets))


def finite_rows(parts: Iterable[Tensor]) -> Tensor:
    """Which rows of `parts`, each [N,...], are finite in all of them: bool [N]."""
    return torch.stack([part.reshape(len(part), -1).isfinite().all(1) for part in parts]).all(0)


def spacing(points: Tensor, extent: float, neighbours: int = 3) -> Tensor:
    """Root mean square distance [N] in metres to the nearest other `points`[N,3], within 1e-7 and 0.1 of `extent`.

    Fewer than 2 points get the upper limit, duplicates the lower.
    """
    if len(points) < 2:
        return torch.full((len(points),), 0.1 * extent).to(points)
    distance, _ = nearest(points, points, neighbours + 1)
    rms = distance[:, 1:].square().mean(1).sqrt().to(points)
    return rms.clamp(SMALLEST * extent, 0.1 * extent)

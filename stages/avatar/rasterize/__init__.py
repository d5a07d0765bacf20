"""3D Gaussians to pixels: one signature, several makers. The torch reference is the specification."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.avatar.rasterize import cpu, cuda, reference
from stages.avatar.rasterize.rendering import Layer, Rendering

__all__ = ["Layer", "Rendering", "gaussian_axes", "rasterize"]


def _fast(like: Tensor) -> bool:
    return like.dtype == torch.float32 and like.device.type == "cpu"


def gaussian_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """Scaled axes [N,3,3] (columns) of Gaussians with rotations quats[N,4] (w x y z, any length) and scales[N,3] m."""
    return (cpu if _fast(quats) else reference).gaussian_axes(quats, scales)


def rasterize(
    means: Tensor,
    axes: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    layers: Sequence[Layer] = (Layer(),),
    antialias: bool = False,
    near: float = 0.01,
) -> list[Rendering]:
    """Draw N Gaussians, nearest first, once for each layer (3DGS, Kerbl et al. 2023; thresholds of gsplat 1.5).

    means[N,3] m; axes[N,3,3], whose columns are the scaled axes: the covariance is axes axes^T, so a Gaussian moved by
    any linear blend needs no polar decomposition; opacities[N] in 0..1; colors[N,3]; viewmat[4,4] camera_from_world
    with OpenCV axes; K[3,3] px, the first pixel centre at (0.5, 0.5). With `antialias` the screen blur is about a pixel
    wide and lowers opacity as it widens a Gaussian (Yu et al. 2024). Gaussians nearer than `near` m are not drawn. At
    most LAYERS of them; projection and depth order are theirs together, and gradients add up.
    Differentiable in means, axes, opacities, colors, viewmat and backgrounds. A row that is not finite is left out and
    counted. Float32 goes to the fast kernel of its device (Numba on a CPU, gsplat on a GPU), float64 to the reference.
    """
    maker = {"cpu": cpu, "cuda": cuda}.get(means.device.type, reference) if means.dtype == torch.float32 else reference
    return maker.rasterize(means, axes, opacities, colors, viewmat, K, width, height, layers, antialias, near)

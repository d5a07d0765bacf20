"""Draws 3D Gaussians: one signature, three implementations. The torch reference specifies them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.avatar.rasterize import again, cpu, cuda, reference
from stages.avatar.rasterize.rendering import NEAR, Camera, Gaussians, Kept, Layer, Rendering

__all__ = ["Camera", "Gaussians", "Kept", "Layer", "Rendering", "gaussian_axes", "rasterize"]


def gaussian_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """Scaled axes [N,3,3] (columns) of Gaussians with rotations quats[N,4] (w x y z, any length) and scales[N,3] m."""
    fast = quats.dtype == torch.float32 and quats.device.type == "cpu"
    return (cpu if fast else reference).gaussian_axes(quats, scales)


def rasterize(
    gaussians: Gaussians, camera: Camera, layers: Sequence[Layer] = (Layer(),), near: float = NEAR
) -> list[Rendering]:
    """Draw N Gaussians, nearest first, once for each layer (3DGS, Kerbl et al. 2023; thresholds of gsplat 1.5).

    Gaussians nearer than `near` m are not drawn. Layers share projection and depth order, on a CPU LAYERS of them at a time,
    and their gradients add up. Differentiable in means, axes, opacities, colors, viewmat, K (without skew) and backgrounds. A
    row that is not finite is left out and counted; ValueError for a camera that is not. Float32 goes to the fast kernel of
    its device (Numba on a CPU, gsplat on a GPU), float64 to the reference.
    """
    for name, part in (("viewmat", camera.viewmat), ("K", camera.K)):
        if not part.detach().isfinite().all():
            raise ValueError(f"the camera's {name} has numbers that are not finite: {part.tolist()}")
    means, kept = gaussians.means, layers[0].kept if len(layers) == 1 else None
    maker = {"cpu": cpu, "cuda": cuda}.get(means.device.type, reference) if means.dtype == torch.float32 else reference
    if maker is cpu and kept is not None:
        return [again.redraw(gaussians, camera, layers[0], near, kept)]
    return maker.rasterize(gaussians, camera if maker is reference else _through_viewmat(camera), layers, near)


def _through_viewmat(camera: Camera) -> Camera:
    """The same camera, whose viewmat carries the gradient of K; kernels have none.

    K V = K0 (S V) with S = K0^-1 K, which is the identity in value; a viewmat need not be rigid.
    """
    if not camera.K.requires_grad:
        return camera
    view, K, fixed = camera.viewmat, camera.K, camera.K.detach()
    focal = fixed.diagonal()[:2]
    zoom, shift = K.diagonal()[:2] / focal, (K[:2, 2] - fixed[:2, 2]) / focal
    return camera._replace(viewmat=torch.cat([zoom[:, None] * view[:2] + shift[:, None] * view[2], view[2:]]), K=fixed)

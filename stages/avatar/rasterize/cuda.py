"""The rasterizer on a GPU: gsplat (Apache-2.0, Ye et al. 2025) behind the signature of the reference."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.avatar.rasterize.rendering import BLUR, NEAR, PIXEL, Camera, Gaussians, Layer, Rendering


def rasterize(
    gaussians: Gaussians, camera: Camera, layers: Sequence[Layer] = (Layer(),), near: float = NEAR
) -> list[Rendering]:
    """As `stages.avatar.rasterize.rasterize`; float32 tensors on one GPU.

    Each layer is a call of its own, whose Jacobian is clamped at the margin of its window, not of the whole picture.
    gsplat compiles its kernels at the first call of an installation. ImportError if it is not installed.
    """
    *parts, antialias = gaussians
    means, axes, opacities, colors = parts
    grad = torch.zeros(len(means), 2, device=means.device)
    finite = torch.stack([part.detach().isfinite()[:, None].flatten(1).all(1) for part in parts]).all(0)
    axes = torch.where(finite[:, None, None], axes, 0)
    seen = (means, axes @ axes.mT, opacities, colors)
    return [_draw(seen, antialias, camera, layer, near, finite, grad) for layer in layers]


def _draw(
    parts: tuple[Tensor, ...], antialias: bool, camera: Camera, layer: Layer, near: float, finite: Tensor, grad: Tensor
) -> Rendering:
    """One layer of the `finite` [N] of N Gaussians: means, covariances, opacities and colours; adds to `grad` [N,2]."""
    from gsplat import rasterization

    means, covariances, opacities, colors = parts
    viewmat, K, width, height = camera
    rows = (finite if layer.rows is None else finite & layer.rows).nonzero()[:, 0]
    if len(rows) < len(means):  # one NaN would spread over whole tiles
        means, covariances, opacities, colors = (part.index_select(0, rows) for part in parts)
    left, top, right, bottom = layer.window or (0, 0, width, height)
    K = K - torch.tensor([[0, 0, left], [0, 0, top], [0, 0, 0]]).to(K)
    picture, alpha, extras = rasterization(
        means=means,
        quats=None,
        scales=None,
        opacities=opacities,
        colors=colors,
        viewmats=viewmat[None],
        Ks=K[None],
        width=right - left,
        height=bottom - top,
        near_plane=near,
        eps2d=PIXEL if antialias else BLUR,
        packed=False,
        backgrounds=None if layer.background is None else layer.background[None],
        render_mode="RGB+D",
        absgrad=True,
        rasterize_mode="antialiased" if antialias else "classic",
        covars=covariances,
    )
    at = extras["means2d"]
    where = torch.full((len(finite), 2), torch.nan, device=means.device)
    radii = torch.zeros(len(finite), device=means.device)
    where[rows] = at.detach()[0] + torch.tensor([left, top]).to(where)
    radii[rows] = extras["radii"][0].amax(-1).to(radii)
    grad_abs = torch.zeros_like(where)
    if at.requires_grad:

        def record(g: Tensor) -> None:
            grad[rows] += g[0]
            grad_abs[rows] = at.absgrad[0]
            handle.remove()  # tensor and hook hold each other, where Python's collector cannot see it

        handle = at.register_hook(record)
    dropped = int((~finite).sum())
    return Rendering(picture[0, ..., :3], alpha[0, ..., 0], picture[0, ..., 3], where, radii, grad, grad_abs, dropped)

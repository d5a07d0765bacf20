"""The rasterizer on a GPU: gsplat (Apache-2.0, Ye et al. 2025) behind the signature of the reference."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.rasterize.rendering import BLUR, Rendering


def rasterize(
    means: Tensor,
    axes: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor | None = None,
    antialias: bool = False,
    near: float = 0.01,
) -> Rendering:
    """Draw Gaussians as `stages.avatar.rasterize.rasterize` says; float32 tensors on one GPU.

    ImportError if gsplat is not installed. gsplat compiles its kernels at the first call of an installation.
    """
    from gsplat import rasterization

    parts = (means, axes, opacities, colors)
    finite = torch.stack([part.detach().isfinite()[:, None].flatten(1).all(1) for part in parts]).all(0)
    rows = finite.nonzero()[:, 0]
    dropped = len(means) - len(rows)
    if dropped:  # one NaN would spread over whole tiles
        means, axes, opacities, colors = (part[rows] for part in parts)
    picture, alpha, extras = rasterization(
        means=means,
        quats=None,
        scales=None,
        opacities=opacities,
        colors=colors,
        viewmats=viewmat[None],
        Ks=K[None],
        width=width,
        height=height,
        near_plane=near,
        eps2d=BLUR,
        packed=False,
        backgrounds=None if background is None else background[None],
        render_mode="RGB+D",
        absgrad=True,
        rasterize_mode="antialiased" if antialias else "classic",
        covars=axes @ axes.mT,
    )
    at = extras["means2d"]
    where = torch.full((len(finite), 2), torch.nan, device=means.device)
    radii = torch.zeros(len(finite), device=means.device)
    where[rows], radii[rows] = at.detach()[0], extras["radii"][0].amax(-1).to(radii)
    grad, grad_abs = torch.zeros_like(where), torch.zeros_like(where)
    if at.requires_grad:

        def record(g: Tensor) -> None:
            grad[rows], grad_abs[rows] = g[0], at.absgrad[0]

        at.register_hook(record)
    return Rendering(picture[0, ..., :3], alpha[0, ..., 0], picture[0, ..., 3], where, radii, grad, grad_abs, dropped)

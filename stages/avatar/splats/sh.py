"""Spherical harmonics as colour: real basis to degree 3, in the order and signs of 3DGS files."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from stages.records import SH_C0

_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / (4 * math.pi))
_C2Z = math.sqrt(5 / (16 * math.pi))
_C3 = tuple(math.sqrt(x / math.pi) for x in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16))

TURNED_AT_ONCE = 1 << 13  # Gaussians: `rotate_sh` needs some kilobytes for each


def bases(degree: int) -> int:
    """Number of basis functions of all degrees up to `degree`."""
    return (degree + 1) ** 2


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit `directions`[N,3] -> [N,(degree+1)^2], Condon-Shortley signs, degree 0 to 3."""
    if not 0 <= degree <= 3:
        raise ValueError(f"spherical harmonics of degree {degree}: 0 to 3 are known")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if degree > 0:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        basis += [_C2 * x * y, -_C2 * y * z, _C2Z * (3 * z * z - 1), -_C2 * x * z, 0.5 * _C2 * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _C3
        basis += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, -1)


class _NotBelowBlack(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor) -> Tensor:
        ctx.save_for_backward(colors)
        return colors.clamp_min(0)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        (colors,) = ctx.saved_tensors
        return torch.where((colors < 0) & (slope > 0), 0, slope)


def sh_colors(sh: Tensor, directions: Tensor | None) -> Tensor:
    """Colours [N,3], not below 0, of coefficients `sh`[N,K,3] seen along unit `directions`[N,3], or None for K = 1.

    The gradient passes through the clamp at 0 where it brightens, so that a colour that became too dark can return. One
    that darkens ends there: else a black colour would sink for ever, and the person's networks with it.
    """
    if directions is None or sh.shape[1] == 1:
        colors = 0.5 + SH_C0 * sh[:, 0]
    else:
        basis = sh_basis(directions, math.isqrt(sh.shape[1]) - 1)
        colors = 0.5 + torch.einsum("nk,nkc->nc", basis, sh)
    return _NotBelowBlack.apply(colors)


def rotate_sh(higher: Tensor, rotations: Tensor) -> Tensor:
    """Higher coefficients [N,K-1,3] of Gaussians that were turned by rotations[N,3,3] or [3,3], K = (degree+1)^2.

    What a Gaussian showed towards d it then shows towards R d. Each degree turns into itself, and its values in more
    directions than it has functions fix it: solved by least squares, exact but for rounding.
    """
    degree = math.isqrt(higher.shape[1] + 1) - 1
    if degree == 0 or len(higher) == 0:
        return higher
    spread = spread_directions(4 * bases(degree)).to(higher.device)
    solve = torch.linalg.pinv(sh_basis(spread, degree)[:, 1:])
    turned = torch.empty_like(higher)
    for rows in torch.arange(len(higher), device=higher.device).split(TURNED_AT_ONCE):
        before = spread @ (rotations if rotations.dim() == 2 else rotations[rows]).to(spread)  # R^T d
        basis = sh_basis(before.flatten(0, -2), degree)[:, 1:].unflatten(0, before.shape[:-1])
        turned[rows] = (solve @ basis @ higher[rows].to(spread)).to(higher)
    return turned


def spread_directions(count: int) -> Tensor:
    """Unit directions [count,3], float64, spread evenly: a spiral from pole to pole."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, around = 1 - 2 * i / count, i * (math.pi * (1 + math.sqrt(5)))
    return torch.stack([around.cos() * (1 - z * z).sqrt(), around.sin() * (1 - z * z).sqrt(), z], 1)


def sh_from_rgb(rgb: Tensor) -> Tensor:
    """Degree-0 coefficient of a colour in 0..1."""
    return (rgb - 0.5) / SH_C0


def with_gain(sh: Tensor, gain: Tensor) -> Tensor:
    """Coefficients sh[N,K,3] whose colours are `gain` times as bright; gain [N,1], [N,3] or [3]."""
    gain = gain[..., None, :]
    scaled = sh * gain
    base = scaled[:, :1] + (gain - 1) * (0.5 / SH_C0)  # a colour is 0.5 + SH_C0 sh0 + higher terms
    return torch.cat([base, scaled[:, 1:]], 1)

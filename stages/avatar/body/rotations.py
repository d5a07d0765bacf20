"""Rotations as vectors, quaternions, 6D and matrices, smooth in value and gradient at their singular points.

All functions keep dtype, device and leading dimensions. NaN goes through as NaN, it is never hidden.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

SERIES_BELOW = 1e-4
"""Squared angle under which the sine quotients are series: the first dropped term is s**3/5040 < 2e-16."""
FLOOR_6D = 1e-3
"""Length under which a 6D half counts as having no direction; bounds the gradient by its inverse."""
PLAIN_6D = 0.1, 1e9
"""Lengths between which plain Gram-Schmidt is as exact; it takes a third of the time."""


@lru_cache(maxsize=64)
def constant(dtype: torch.dtype, device: torch.device, *numbers: float) -> Tensor:
    """Numbers that never change, on a device: a copy of each to a GPU would wait for it. Nobody may write into it."""
    return torch.tensor(numbers, dtype=dtype, device=device)


def matrix_from_rotvec(rotvec: Tensor) -> Tensor:
    """Rotation vectors [..., 3] in radians to matrices [..., 3, 3]; at zero the gradient is the so(3) generators.

    R = I + sinc(t) K + sinc(t/2)^2/2 K^2, with the half angle because 1 - cos t cancels for small t.
    """
    squared = (rotvec * rotvec).sum(-1)
    small = squared < SERIES_BELOW
    s = torch.where(small, squared, 0.0)
    theta = torch.where(small, 1.0, squared).sqrt()
    a = torch.where(small, 1 - s / 6 + s * s / 120, theta.sin() / theta)
    b = torch.where(small, 0.5 - s / 24 + s * s / 720, 2 * ((theta / 2).sin() / theta) ** 2)
    k = cross_matrix(rotvec)
    return (
        torch.eye(3, dtype=rotvec.dtype, device=rotvec.device) + a[..., None, None] * k + b[..., None, None] * (k @ k)
    )


def cross_matrix(v: Tensor) -> Tensor:
    """Vectors [..., 3] to the matrices [..., 3, 3] that take w to v x w."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def rotvec_from_matrix(matrix: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] to rotation vectors [..., 3] of length at most pi.

    At pi the axis has either sign. Value and gradient are finite there and at the identity.
    """
    quat = quat_from_matrix(matrix)
    w, v = quat[..., :1], quat[..., 1:]
    squared = (v * v).sum(-1, keepdim=True)
    small = squared < SERIES_BELOW
    length = torch.where(small, 1.0, squared).sqrt()
    # w is about 1 where v is small; atan(l/w)/l = 1/w - l^2/(3 w^3) + l^4/(5 w^5)
    near = torch.where(small, w, 1.0)
    ratio = torch.where(small, squared, 0.0) / (near * near)
    return 2 * v * torch.where(small, (1 - ratio / 3 + ratio * ratio / 5) / near, torch.atan2(length, w) / length)


def quat_from_matrix(matrix: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] to unit quaternions [..., 4], w x y z, w >= 0.

    The matrix gives 4 q q^T linearly; its column with the largest diagonal, normalised, is q: never a division by
    less than 2, so the half turns are as exact as the rest.
    """
    m = matrix
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    ww, xx, yy, zz = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    outer = torch.stack([ww, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz], -1).unflatten(-1, (4, 4))
    largest = torch.stack([ww, xx, yy, zz], -1).argmax(-1)
    column = outer.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    quat = column / column.norm(dim=-1, keepdim=True)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def matrix_from_quat(quat: Tensor) -> Tensor:
    """Quaternions [..., 4], w x y z, of any length, to matrices [..., 3, 3]; q and -q give the same, 0 the identity.

    The length cancels, so it is divided out through the largest entry first: 1e-25 and 1e20 neither underflow nor
    overflow. The zero quaternion has zero gradient.
    """
    largest = quat.detach().abs().amax(-1, keepdim=True)
    q = torch.where(
        largest == 0, constant(quat.dtype, quat.device, 1, 0, 0, 0), quat / torch.where(largest == 0, 1.0, largest)
    )
    w, v = q[..., 0, None, None], q[..., 1:]
    k = cross_matrix(v)
    double = 2 / (q * q).sum(-1)[..., None, None]
    return torch.eye(3, dtype=quat.dtype, device=quat.device) + double * (w * k + k @ k)


def matrix_from_6d(six: Tensor) -> Tensor:
    """First two columns [..., 6] = (a, b) of a rotation, unnormalised, to matrices [..., 3, 3] by Gram-Schmidt.

    Zhou et al. 2019 (arXiv 1812.07035). Where a half is near zero, or both within about 1e-3 rad of parallel, a fixed
    axis stands in without gradient, so the gradient never passes about 1/FLOOR_6D.
    """
    plain = _plain_matrix_from_6d(six)
    return _any_matrix_from_6d(six) if plain is None else plain


def _plain_matrix_from_6d(six: Tensor) -> Tensor | None:
    """`matrix_from_6d` where all lengths are within PLAIN_6D, else None."""
    ax, ay, az, bx, by, bz = six.reshape(-1, 6).T.contiguous()
    squared = ax * ax + ay * ay + az * az
    length = squared.sqrt()
    ax, ay, az = ax / length, ay / length, az / length
    along = ax * bx + ay * by + az * bz
    bx, by, bz = bx - along * ax, by - along * ay, bz - along * az
    across = bx * bx + by * by + bz * bz
    least, most = (bound**2 for bound in PLAIN_6D)
    with torch.no_grad():
        whole = across + along * along
        well = (squared > least) & (squared < most) & (whole < most) & (across > least * whole.clamp_min(1))
    if not well.all():
        return None
    length = across.sqrt()
    bx, by, bz = bx / length, by / length, bz / length
    columns = [ax, bx, ay * bz - az * by, ay, by, az * bx - ax * bz, az, bz, ax * by - ay * bx]
    return torch.stack(columns, -1).view(*six.shape[:-1], 3, 3)


def _any_matrix_from_6d(six: Tensor) -> Tensor:
    a, b = (_tamed(half) for half in six.unflatten(-1, (2, 3)).unbind(-2))
    e1 = _unit_or(a, _short(a), constant(a.dtype, a.device, 1, 0, 0).expand_as(a))
    u = b - (e1 * b).sum(-1, keepdim=True) * e1
    least = torch.nn.functional.one_hot(e1.detach().abs().argmin(-1), 3).to(e1)
    e2 = _unit_or(u, _flat(u, b), least - (e1 * least).sum(-1, keepdim=True) * e1.detach())
    e2 = e2 - (e1 * e2).sum(-1, keepdim=True) * e1
    e2 = e2 / e2.norm(dim=-1, keepdim=True)
    return torch.stack([e1, e2, torch.linalg.cross(e1, e2)], -1)


def rotation_z_to(normals: Tensor) -> Tensor:
    """Smallest rotations [..., 3, 3] taking +z to `normals` [..., 3] of any length; identity for a zero normal.

    Built for the half space z >= 0, and reached by a half turn about x from the other: 1 + |z| is at least 1, so both
    poles are exact.
    """
    largest = normals.detach().abs().amax(-1, keepdim=True)
    zero = largest == 0
    n = torch.where(zero, constant(normals.dtype, normals.device, 0, 0, 1), normals / torch.where(zero, 1.0, largest))
    n = n / n.norm(dim=-1, keepdim=True)
    down = n[..., 2:] < 0
    half_turn = constant(normals.dtype, normals.device, 1, -1, -1)
    x, y, z = torch.where(down, n * half_turn, n).unbind(-1)
    k = 1 / (1 + z)
    rows = [1 - x * x * k, -x * y * k, x, -x * y * k, 1 - y * y * k, y, -x, -y, z]
    up = torch.stack(rows, -1).unflatten(-1, (3, 3))
    return torch.where(down[..., None], up * half_turn[:, None], up)


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Angle [...] in radians, 0 to pi, between rotation matrices [..., 3, 3]; a measure, not a loss.

    By the chord (2 asin |a-b|/sqrt 8), because acos of a trace loses half the digits near 0.
    """
    return 2 * ((a - b).flatten(-2).norm(dim=-1) / 8**0.5).clamp(max=1).asin()


def _tamed(v: Tensor) -> Tensor:
    """Vectors with the length above 1 divided out, so that squares cannot overflow; the direction is unchanged."""
    return v / v.detach().abs().amax(-1, keepdim=True).clamp(min=1)


def _short(v: Tensor) -> Tensor:
    return v.detach().norm(dim=-1, keepdim=True) < FLOOR_6D


def _flat(u: Tensor, b: Tensor) -> Tensor:
    return u.detach().norm(dim=-1, keepdim=True) < FLOOR_6D * b.detach().norm(dim=-1, keepdim=True).clamp(min=1)


def _unit_or(v: Tensor, bad: Tensor, instead: Tensor) -> Tensor:
    chosen = torch.where(bad, instead.detach(), v)
    return chosen / chosen.norm(dim=-1, keepdim=True)

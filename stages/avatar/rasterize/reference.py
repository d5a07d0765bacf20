"""The specification of the rasterizer in plain torch: every Gaussian on every pixel, any dtype, gradients by autograd."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.avatar.rasterize.rendering import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUR,
    COMPENSATION_MIN,
    FRUSTUM_MARGIN,
    NEAR,
    PIXEL,
    T_STOP,
    Camera,
    Gaussians,
    Layer,
    Rendering,
)

PIXELS = 4096  # drawn at a time, to bound memory


def gaussian_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """Scaled axes [N,3,3] (columns) of Gaussians with rotations quats[N,4] (w x y z, normalised here) and scales[N,3].

    A zero quaternion gives not-a-number axes, which the rasterizer drops and counts.
    """
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, 1) for row in rows], 1) * scales[:, None, :]


def rasterize(
    gaussians: Gaussians, camera: Camera, layers: Sequence[Layer] = (Layer(),), near: float = NEAR
) -> list[Rendering]:
    """As `stages.avatar.rasterize.rasterize`; differentiable in all tensors, also twice."""
    means = gaussians.means
    grad = torch.zeros(len(means), 2, dtype=means.dtype, device=means.device)
    return [_draw(gaussians, camera, layer, near, grad) for layer in layers]


def _draw(gaussians: Gaussians, camera: Camera, layer: Layer, near: float, grad: Tensor) -> Rendering:
    means, axes, opacities, colors, antialias = gaussians
    viewmat, K, width, height = camera
    n = len(means)
    finite = torch.stack([part.detach().isfinite()[:, None].flatten(1).all(1) for part in gaussians[:4]]).all(0)
    with torch.no_grad():
        z = means @ viewmat[2, :3] + viewmat[2, 3]
        kept = finite & (z > near) if layer.rows is None else finite & (z > near) & layer.rows
        rows = kept.nonzero()[:, 0]
        rows = rows[z[rows].argsort(stable=True)]
    local = means[rows] @ viewmat[:3, :3].T + viewmat[:3, 3]
    means2d, a, b = _project(local, viewmat[:3, :3] @ axes[rows], K, width, height)
    blur = PIXEL if antialias else BLUR
    aa, bb, ab = (a * a).sum(1) + blur, (b * b).sum(1) + blur, (a * b).sum(1)
    sharp = torch.linalg.cross(a, b).square().sum(1)
    det = sharp + blur * (aa + bb - blur)
    opacity = opacities[rows]
    if antialias:
        opacity = opacity * (sharp / det).clamp_min(COMPENSATION_MIN**2).sqrt()
    with torch.no_grad():
        half = (aa + bb) / 2
        longest = half + torch.hypot((aa - bb) / 2, ab)
        reach = 2 * (opacity / ALPHA_MIN).clamp_min(1).log()
        across, down = (reach * aa).sqrt(), (reach * bb).sqrt()
        seen = (means2d[:, 0] + across > 0) & (means2d[:, 0] - across < width)
        seen &= (means2d[:, 1] + down > 0) & (means2d[:, 1] - down < height) & (opacity >= ALPHA_MIN)
        radii = torch.zeros(n, dtype=means.dtype, device=means.device)
        radii[rows] = torch.where(seen, (reach * longest).sqrt().ceil(), 0)
    where = torch.full((n, 2), torch.nan, dtype=means.dtype, device=means.device)
    where[rows] = means2d.detach()
    grad_abs = torch.zeros_like(where)

    left, top, right, bottom = layer.window or (0, 0, width, height)
    ys, xs = (torch.arange(*ends).to(means) + 0.5 for ends in ((top, bottom), (left, right)))
    ys, xs = torch.meshgrid(ys, xs, indexing="ij")
    pixels = torch.stack([xs, ys], -1).reshape(-1, 1, 2)
    drawn = []
    for chunk in pixels.split(PIXELS):
        offset = chunk - means2d
        if offset.requires_grad:

            def record(g: Tensor) -> None:
                grad.index_add_(0, rows, -g.sum(0))
                grad_abs.index_add_(0, rows, g.abs().sum(0))

            offset.register_hook(record)
        dx, dy = offset.unbind(-1)
        first = dx / aa.sqrt()
        second = (dy - ab / aa * dx) / (det / aa).sqrt()
        alpha = opacity * torch.exp(-(first * first + second * second) / 2)  # by Cholesky: never above opacity
        alpha = torch.where(alpha < ALPHA_MIN, 0, alpha.clamp(max=ALPHA_MAX))
        passed = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], 1) if len(rows) else passed
        weight = torch.where(passed > T_STOP, alpha * before, 0)
        final = torch.where(passed > T_STOP, 1 - alpha, 1).prod(1)
        drawn.append(torch.cat([weight @ colors[rows], weight @ local[:, 2:], final[:, None]], 1))
    picture = torch.cat(drawn).reshape(bottom - top, right - left, 5)
    image, depth, final = picture[..., :3], picture[..., 3], picture[..., 4]
    if layer.background is not None:
        image = image + final[..., None] * layer.background
    return Rendering(image, 1 - final, depth, where, radii, grad, grad_abs, int((~finite).sum()))


def _project(local: Tensor, turned: Tensor, K: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Screen positions [M,2] px and the rows a, b [M,3] of Jacobian x axes; local[M,3] camera frame, turned[M,3,3].

    The view direction in the Jacobian is clamped at a margin outside the picture, so that a Gaussian far off the axis
    cannot smear across it; the limits follow the principal point (hard cases A08, A11).
    """
    x, y, z = local.unbind(1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    u, v = x / z, y / z
    uc = u.clamp((-cx - FRUSTUM_MARGIN * width) / fx, (width - cx + FRUSTUM_MARGIN * width) / fx)
    vc = v.clamp((-cy - FRUSTUM_MARGIN * height) / fy, (height - cy + FRUSTUM_MARGIN * height) / fy)
    a = (fx / z)[:, None] * (turned[:, 0] - uc[:, None] * turned[:, 2])
    b = (fy / z)[:, None] * (turned[:, 1] - vc[:, None] * turned[:, 2])
    return torch.stack([fx * u + cx, fy * v + cy], 1), a, b

"""The rasterizer on a CPU: compiled kernels behind the signature of the reference, with hand-written gradients."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stages.avatar.rasterize import blend, kernels
from stages.avatar.rasterize.rendering import Rendering

CHUNKS = 16  # ranges of rows in passes over Gaussians: fixed, so that results do not depend on the thread count


def _array(tensor: Tensor, dtype: type = np.float32) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), dtype)


def _records(n: int) -> np.ndarray:
    """Uninitialised float32 [n,16], each row on one cache line."""
    raw = np.empty(n * blend.ROW + 16, np.float32)
    start = -raw.ctypes.data % 64 // 4
    return raw[start : start + n * blend.ROW].reshape(n, blend.ROW)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, axes, opacities, colors, viewmat, background, K, size, antialias, near, extras):
        width, height = size
        arrays = [_array(t) for t in (means, axes, opacities, colors)]
        view, intrinsics = _array(viewmat, np.float64), _array(K, np.float64)
        n, threads = len(means), torch.get_num_threads()
        records, means2d, radii = _records(n), np.empty((n, 2), np.float32), np.empty(n, np.float32)
        dropped = kernels.project(
            *arrays, view, intrinsics, width, height, antialias, near, CHUNKS, records, means2d, radii
        )
        order = kernels.depth_order(records, radii)
        starts, rows = kernels.tile_lists(order, records, width, height, CHUNKS)
        image, alpha = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
        depth = np.empty_like(alpha)
        finals = np.empty((len(starts) - 1, blend.AREA), np.float32)
        lasts = np.empty((len(starts) - 1, blend.AREA), np.int32)
        scene = (starts, rows, records, width, height, _array(background), threads, blend.IN_X, blend.IN_Y)
        blend.draw(*scene, image, alpha, depth, finals, lasts)
        ctx.kept = (*arrays[:3], view, intrinsics, width, height, antialias, records, radii), (*scene, finals, lasts)
        ctx.extras = extras
        extras.update(means2d=means2d, radii=radii, dropped=int(dropped))
        extras.update(screen_grad=torch.zeros(n, 2), screen_grad_abs=torch.zeros(n, 2))
        return tuple(torch.from_numpy(t) for t in (image, alpha, depth))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, v_image, v_alpha, v_depth):
        (means, axes, opacities, view, K, width, height, antialias, records, radii), scene = ctx.kept
        *scene, finals, lasts = scene
        n, _background, threads = len(means), scene[5], scene[6]
        v_image, v_alpha, v_depth = (_array(v) for v in (v_image, v_alpha, v_depth))
        partial = _records(threads * n).reshape(threads, n, blend.ROW)
        blend.draw_backward(*scene, finals, lasts, v_image, v_alpha, v_depth, partial)
        screen = tuple(ctx.extras[name].numpy() for name in ("screen_grad", "screen_grad_abs"))
        grads = tuple(np.empty(s, np.float32) for s in ((n, 3), (n, 3, 3), (n,), (n, 3)))
        d_view = kernels.project_backward(
            means,
            axes,
            opacities,
            view,
            K,
            width,
            height,
            antialias,
            CHUNKS,
            records,
            radii,
            partial,
            (*grads, *screen),
        )
        d_background = None
        if ctx.needs_input_grad[5]:
            light = 1 - ctx.extras["alpha"].numpy()
            d_background = torch.from_numpy(np.einsum("hw,hwc->c", light, v_image, dtype=np.float64).astype(np.float32))
        return (
            *(torch.from_numpy(g) for g in grads),
            torch.from_numpy(d_view.astype(np.float32)),
            d_background,
            *[None] * 5,
        )


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
    """Draw Gaussians as `stages.avatar.rasterize.rasterize` says; float32 tensors on the CPU.

    The picture is the same to the bit for any number of threads; gradients are for a fixed number.
    """
    background = torch.zeros(3) if background is None else background
    extras: dict = {}
    image, alpha, depth = _Rasterize.apply(
        means, axes, opacities, colors, viewmat, background, K, (width, height), antialias, near, extras
    )
    extras["alpha"] = alpha.detach()
    means2d, radii = torch.from_numpy(extras["means2d"]), torch.from_numpy(extras["radii"])
    return Rendering(
        image, alpha, depth, means2d, radii, extras["screen_grad"], extras["screen_grad_abs"], extras["dropped"]
    )


class _Axes(torch.autograd.Function):
    @staticmethod
    def forward(ctx, quats, scales):
        arrays = _array(quats), _array(scales)
        axes = np.empty((len(quats), 3, 3), np.float32)
        kernels.axes_forward(*arrays, CHUNKS, axes)
        ctx.kept = *arrays, axes
        return torch.from_numpy(axes)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, d_axes):
        quats, scales, axes = ctx.kept
        d_quats, d_scales = np.empty_like(quats), np.empty_like(scales)
        kernels.axes_backward(quats, scales, axes, _array(d_axes), CHUNKS, d_quats, d_scales)
        return torch.from_numpy(d_quats), torch.from_numpy(d_scales)


def gaussian_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """The reference's `gaussian_axes`, fused."""
    return _Axes.apply(quats, scales)

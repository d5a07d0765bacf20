"""The rasterizer on a CPU: compiled kernels behind the signature of the reference, with hand-written gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.avatar.rasterize import blend
from stages.avatar.rasterize import projection as kernels
from stages.avatar.rasterize.rendering import LAYERS, NEAR, T_STOP, Camera, Gaussians, Layer, Rendering
from stages.avatar.rasterize.tiles import tile_lists

CHUNKS = 16  # ranges of rows in passes over Gaussians: fixed, so that results do not depend on the thread count


def as_array(tensor: Tensor, dtype: type = np.float32) -> np.ndarray:
    """A tensor's numbers, contiguous, without a copy where they are."""
    return np.ascontiguousarray(tensor.detach().numpy(), dtype)


def empty_records(n: int) -> np.ndarray:
    """Uninitialised float32 [n,16], each row on one cache line."""
    raw = np.empty(n * kernels.ROW + 16, np.float32)
    start = -raw.ctypes.data % 64 // 4
    return raw[start : start + n * kernels.ROW].reshape(n, kernels.ROW)


class _Rasterize(torch.autograd.Function):
    """Inputs end in the layers' backgrounds; outputs are image, alpha and depth of each layer in turn.

    `viewmat` repeats `camera.viewmat`, for its gradient.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        axes: Tensor,
        opacities: Tensor,
        colors: Tensor,
        viewmat: Tensor,
        camera: Camera,
        layers: Sequence[Layer],
        antialias: bool,
        near: float,
        extras: dict[str, Any],
        *backgrounds: Tensor | None,
    ) -> tuple[Tensor, ...]:
        _, K, width, height = camera
        arrays = [as_array(t) for t in (means, axes, opacities, colors)]
        view, intrinsics = as_array(viewmat, np.float64), as_array(K, np.float64)
        n, threads = len(means), torch.get_num_threads()
        records, means2d, radii = empty_records(n), np.empty((n, 2), np.float32), np.empty(n, np.float32)
        dropped = kernels.project(
            *arrays, view, intrinsics, width, height, antialias, near, CHUNKS, records, means2d, radii
        )
        order = kernels.depth_order(records, radii)
        kept, pictures = [], []
        for layer, background in zip(layers, backgrounds, strict=True):
            left, top, right, bottom = map(int, layer.window or (0, 0, width, height))
            window = left, top, right, bottom
            some = order if layer.rows is None else order[layer.rows.numpy()[order]]
            starts, rows, masks = tile_lists(some, records.reshape(-1), window, CHUNKS)
            ground = np.zeros(3, np.float32) if background is None else as_array(background)
            shape = bottom - top, right - left
            image, alpha, depth = (np.empty((*shape, *rest), np.float32) for rest in ((3,), (), ()))
            finals, stops = (np.empty((len(starts) - 1, blend.AREA), kind) for kind in (np.float32, np.int32))
            place = (starts, rows, masks, records.reshape(-1), window, ground, threads, blend.IN_X, blend.IN_Y)
            blend.draw(*place, np.full(len(finals), blend.ALL), np.float32(T_STOP), image, alpha, depth, finals, stops)
            kept.append((place, finals, stops, alpha))
            pictures += [torch.from_numpy(t) for t in (image, alpha, depth)]
        ctx.kept = (*arrays[:3], view, intrinsics, width, height, antialias), radii, kept
        ctx.extras = extras
        ctx.set_materialize_grads(False)
        extras.update(means2d=torch.from_numpy(means2d), radii=torch.from_numpy(radii), dropped=int(dropped))
        extras.update(screen_grad=torch.zeros(n, 2), screen_grad_abs=torch.zeros(len(layers), n, 2))
        return tuple(pictures)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple[Tensor | None, ...]:
        parts, radii, kept = ctx.kept
        n, threads = len(radii), kept[0][0][6]
        sums = empty_records(threads * n).reshape(threads, n * kernels.ROW)
        kernels.clear(sums)
        d_backgrounds = []
        for number, (place, finals, stops, alpha) in enumerate(kept):
            arrived = upstream[3 * number : 3 * number + 3]
            d_background = None
            if any(v is not None for v in arrived):
                shapes = ((*alpha.shape, 3), alpha.shape, alpha.shape)
                arrays = [np.zeros(s, np.float32) if v is None else as_array(v) for s, v in zip(shapes, arrived)]
                blend.draw_backward(*place, finals, stops, *arrays, number, sums)
                if ctx.needs_input_grad[10 + number]:
                    light = np.einsum("hw,hwc->c", 1 - alpha, arrays[0], dtype=np.float64)
                    d_background = torch.from_numpy(light.astype(np.float32))
            d_backgrounds.append(d_background)
        grads = [np.empty(s, np.float32) for s in ((n, 3), (n, 3, 3), (n,), (n, 3))]
        screen = [ctx.extras[name].numpy() for name in ("screen_grad", "screen_grad_abs")]
        by_thread = sums.reshape(threads, n, kernels.ROW)
        camera = ctx.needs_input_grad[4]
        d_view = kernels.project_backward(*parts, CHUNKS, radii, by_thread, camera, (*grads, *screen)).sum(0)
        slopes = [torch.from_numpy(g) for g in (*grads, d_view.astype(np.float32))]
        return (*slopes, *[None] * 5, *d_backgrounds)


def rasterize(
    gaussians: Gaussians, camera: Camera, layers: Sequence[Layer] = (Layer(),), near: float = NEAR
) -> list[Rendering]:
    """As `stages.avatar.rasterize.rasterize`; float32 tensors on the CPU.

    Pictures are the same to the bit for any number of threads, gradients for a fixed number. More than LAYERS are drawn one
    after the other, since a row of gradients has no room for more.
    """
    if len(layers) > LAYERS:
        parts_of = (layers[i : i + LAYERS] for i in range(0, len(layers), LAYERS))
        return [drawn for some in parts_of for drawn in rasterize(gaussians, camera, some, near)]
    extras: dict[str, Any] = {}
    grounds = [layer.background for layer in layers]
    *parts, antialias = gaussians
    pictures = _Rasterize.apply(*parts, camera.viewmat, camera, layers, antialias, near, extras, *grounds)
    drawn = []
    for number, layer in enumerate(layers):
        radii = extras["radii"] if layer.rows is None else torch.where(layer.rows, extras["radii"], 0)
        image, alpha, depth = pictures[3 * number : 3 * number + 3]
        screen = extras["means2d"], radii, extras["screen_grad"], extras["screen_grad_abs"][number]
        drawn.append(Rendering(image, alpha, depth, *screen, extras["dropped"]))
    return drawn


class _Axes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, scales: Tensor) -> Tensor:
        arrays = as_array(quats), as_array(scales)
        axes = np.empty((len(quats), 3, 3), np.float32)
        kernels.axes_forward(*arrays, CHUNKS, axes)
        ctx.kept = *arrays, axes
        return torch.from_numpy(axes)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, d_axes: Tensor) -> tuple[Tensor, Tensor]:
        quats, scales, axes = ctx.kept
        d_quats, d_scales = np.empty_like(quats), np.empty_like(scales)
        kernels.axes_backward(quats, scales, axes, as_array(d_axes), CHUNKS, d_quats, d_scales)
        return torch.from_numpy(d_quats), torch.from_numpy(d_scales)


def gaussian_axes(quats: Tensor, scales: Tensor) -> Tensor:
    """The reference's `gaussian_axes`, fused."""
    return _Axes.apply(quats, scales)

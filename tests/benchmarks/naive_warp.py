"""The naive rasterizer once more, in NVIDIA Warp on its CPU device: a thread a pixel, atomic gradients.

Importing this module needs `pip install warp-lang`. Warp's CPU device runs on one thread.
"""

import numpy as np
import warp as wp

from stages.avatar.rasterize.rendering import ALPHA_MAX, ALPHA_MIN, T_STOP
from tests.benchmarks.naive import TILE, Screen, Workload

wp.config.log_level = wp.LOG_ERROR
SIDE = wp.constant(TILE)
FAINTEST, LARGEST, STOP = wp.constant(ALPHA_MIN), wp.constant(ALPHA_MAX), wp.constant(T_STOP)


@wp.func
def _offset(mean: wp.vec2, x: int, y: int):
    return wp.vec2(float(x) + 0.5, float(y) + 0.5) - mean


@wp.func
def _falloff(d: wp.vec2, conic: wp.vec3):
    power = 0.5 * (conic[0] * d[0] * d[0] + conic[2] * d[1] * d[1]) + conic[1] * d[0] * d[1]
    return wp.exp(-wp.max(power, 0.0))


@wp.kernel(enable_backward=False)
def _forward(
    means2d: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    colors: wp.array(dtype=wp.vec3),
    starts: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    across: int,
    image: wp.array2d(dtype=wp.vec3),
    finals: wp.array2d(dtype=float),
    lasts: wp.array2d(dtype=int),
):
    y, x = wp.tid()
    tile = y // SIDE * across + x // SIDE
    light = wp.float32(1.0)
    last = wp.int32(-1)
    color = wp.vec3()
    for k in range(starts[tile], starts[tile + 1]):
        i = rows[k]
        alpha = opacities[i] * _falloff(_offset(means2d[i], x, y), conics[i])
        if alpha < FAINTEST:
            continue
        alpha = wp.min(alpha, LARGEST)
        if light * (1.0 - alpha) <= STOP:
            break
        color += alpha * light * colors[i]
        light *= 1.0 - alpha
        last = k
    image[y, x] = color
    finals[y, x] = light
    lasts[y, x] = last


@wp.kernel(enable_backward=False)
def _backward(
    means2d: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    colors: wp.array(dtype=wp.vec3),
    starts: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    across: int,
    finals: wp.array2d(dtype=float),
    lasts: wp.array2d(dtype=int),
    v_image: wp.array2d(dtype=wp.vec3),
    v_means2d: wp.array(dtype=wp.vec2),
    v_conics: wp.array(dtype=wp.vec3),
    v_opacities: wp.array(dtype=float),
    v_colors: wp.array(dtype=wp.vec3),
):
    y, x = wp.tid()
    tile = y // SIDE * across + x // SIDE
    light = wp.float32(finals[y, x])
    behind = wp.float32(0.0)
    v = v_image[y, x]
    start = starts[tile]
    for back in range(lasts[y, x] - start + 1):
        i = rows[lasts[y, x] - back]
        conic = conics[i]
        d = _offset(means2d[i], x, y)
        full = opacities[i] * _falloff(d, conic)
        if full < FAINTEST:
            continue
        alpha = wp.min(full, LARGEST)
        light /= 1.0 - alpha
        value = wp.dot(v, colors[i])
        if full < LARGEST:
            g = alpha * (value * light - behind / (1.0 - alpha))
            slope = wp.vec2(conic[0] * d[0] + conic[1] * d[1], conic[1] * d[0] + conic[2] * d[1])
            wp.atomic_add(v_means2d, i, g * slope)
            wp.atomic_add(v_conics, i, -g * wp.vec3(0.5 * d[0] * d[0], d[0] * d[1], 0.5 * d[1] * d[1]))
            wp.atomic_add(v_opacities, i, g / opacities[i])
        behind += value * alpha * light
        wp.atomic_add(v_colors, i, alpha * light * v)


class NaiveWarp:
    """The Warp kernel on one workload."""

    def __init__(self, work: Workload, screen: Screen):
        types = (wp.vec2, wp.vec3, float, wp.vec3, int, int)
        arrays = [wp.array(a, dtype=t, device="cpu") for a, t in zip(screen, types, strict=True)]
        self.size = (work.camera.height, work.camera.width)
        self.inputs = [*arrays, -(-work.camera.width // TILE)]
        self.image, self.finals, self.lasts = (
            wp.empty(self.size, dtype=t, device="cpu") for t in (wp.vec3, float, int)
        )
        self.v_image = wp.array(work.v_image.numpy(), dtype=wp.vec3, device="cpu")
        self.sums = [wp.zeros_like(a) for a in arrays[:4]]

    def forward(self) -> np.ndarray:
        """The image [H,W,3]."""
        wp.launch(_forward, self.size, self.inputs, [self.image, self.finals, self.lasts], device="cpu")
        return self.image.numpy()

    def backward(self) -> None:
        """Sum the gradients of `forward`'s image."""
        for part in self.sums:
            part.zero_()
        wp.launch(_backward, self.size, [*self.inputs, self.finals, self.lasts, self.v_image], self.sums, device="cpu")

    def gradients(self) -> tuple[np.ndarray, np.ndarray]:
        """Of means2d [N,2] and colors [N,3]."""
        return self.sums[0].numpy(), self.sums[3].numpy()

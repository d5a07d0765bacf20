"""The passes of the CPU rasterizer over Gaussians: projection and its backward, and depth order.

Gaussians are independent rows here, so each pass is plain scalar code, spread over threads. Projection runs in float64
(a needle's determinant cancels in float32); what the blend reads is one 64-byte record a Gaussian.
"""

from __future__ import annotations

import math

import numpy as np

from stages.avatar.kernels import njit, prange
from stages.avatar.rasterize.rendering import ALPHA_MIN, BLUR, COMPENSATION_MIN, FRUSTUM_MARGIN, PIXEL

LOG2E = 1.4426950408889634
ROW = 16  # floats in a record and in a gradient row: one cache line
# columns of a record; the exponent is LOG_OPACITY + QA u^2 + QC dy^2 with u = dx + SLOPE dy and negative QA and QC: as a
# sum of squares it never cancels
X, Y, QA, SLOPE, QC, LOG_OPACITY, RED, GREEN, BLUE, DEPTH, REACH_X, REACH_Y, SLANT_X, CUT, INVERSE_DET = range(15)
# columns of a Gaussian's gradient; the rest of the row are two absolute sums for each layer
G, GU, GY, GUU, GUY, GYY, G_RED, G_GREEN, G_BLUE, G_DEPTH, ABS = range(11)


@njit(cache=True, inline="always")
def _turned(view, axes, i, r):
    """Row r of the camera's rotation times the axes of Gaussian i."""
    v0, v1, v2 = view[r, 0], view[r, 1], view[r, 2]
    return (
        v0 * axes[i, 0, 0] + v1 * axes[i, 1, 0] + v2 * axes[i, 2, 0],
        v0 * axes[i, 0, 1] + v1 * axes[i, 1, 1] + v2 * axes[i, 2, 1],
        v0 * axes[i, 0, 2] + v1 * axes[i, 1, 2] + v2 * axes[i, 2, 2],
    )


@njit(cache=True, inline="always")
def _local(view, m, i, r):
    """Coordinate r of mean i in the camera's frame."""
    return view[r, 0] * m[i, 0] + view[r, 1] * m[i, 1] + view[r, 2] * m[i, 2] + view[r, 3]


@njit(cache=True, inline="always")
def _clamped(slope, f, c, size):
    """The view direction of the Jacobian along one side of the picture (hard cases A08, A11)."""
    return min(max(slope, (-c - FRUSTUM_MARGIN * size) / f), (size - c + FRUSTUM_MARGIN * size) / f)


@njit(cache=True, inline="always")
def _plus(p, a, q, b):
    """p a + q b of vectors a, b [3]."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@njit(cache=True, inline="always")
def _sharp(a, b):
    """|a x b|^2, the determinant of the covariance without blur, as a sum of squares."""
    n0, n1, n2 = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return n0 * n0 + n1 * n1 + n2 * n2


@njit(cache=True, inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, parallel=True)
def project(means, axes, opacities, colors, view, K, width, height, antialias, near, chunks, records, means2d, radii):
    """Fill records [N,16], means2d [N,2] px and radii [N] px (0 = not drawn); returns how many rows are not finite.

    The work is cut into `chunks` ranges of rows. view [4,4] and K [3,3] float64, the rest float32.
    """
    n = len(means)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    blur = PIXEL if antialias else BLUR
    bad = np.zeros(chunks, np.int64)
    for chunk in prange(chunks):
        for i in range(chunk * n // chunks, (chunk + 1) * n // chunks):
            radii[i] = 0
            means2d[i, 0] = means2d[i, 1] = np.nan
            probe = np.float64(opacities[i])
            for c in range(3):
                probe += np.float64(means[i, c]) + np.float64(colors[i, c])
                probe += np.float64(axes[i, 0, c]) + np.float64(axes[i, 1, c]) + np.float64(axes[i, 2, c])
            if not math.isfinite(probe):
                bad[chunk] += 1
                continue
            z = _local(view, means, i, 2)
            if not z > near:
                continue
            x, y = _local(view, means, i, 0), _local(view, means, i, 1)
            u, v = _clamped(x / z, fx, cx, width), _clamped(y / z, fy, cy, height)
            forward = _turned(view, axes, i, 2)
            a = _plus(fx / z, _turned(view, axes, i, 0), -fx / z * u, forward)
            b = _plus(fy / z, _turned(view, axes, i, 1), -fy / z * v, forward)
            px, py = fx * x / z + cx, fy * y / z + cy
            means2d[i, 0], means2d[i, 1] = px, py
            sharp, aa, bb, ab = _sharp(a, b), _dot(a, a) + blur, _dot(b, b) + blur, _dot(a, b)
            det = sharp + blur * (aa + bb - blur)
            opacity = np.float64(opacities[i])
            if antialias:
                opacity *= math.sqrt(max(sharp / det, COMPENSATION_MIN**2))
            if not opacity >= ALPHA_MIN:
                continue
            log_opacity = math.log2(opacity)
            cut = max(0.0, 2 / LOG2E * (log_opacity - math.log2(ALPHA_MIN)))
            reach_x, reach_y = math.sqrt(cut * aa), math.sqrt(cut * bb)
            # `not`, so that NaN is out of view, too
            if not (px + reach_x > 0 and px - reach_x < width and py + reach_y > 0 and py - reach_y < height):
                continue
            half = 0.5 * (aa + bb)
            longest = half + math.sqrt(0.25 * (aa - bb) ** 2 + ab * ab)
            radii[i] = np.ceil(math.sqrt(cut * longest))  # math.ceil would overflow
            r = records[i]
            r[X], r[Y] = px, py
            r[QA], r[SLOPE], r[QC] = -0.5 * LOG2E * bb / det, -ab / bb, -0.5 * LOG2E / bb
            r[LOG_OPACITY] = log_opacity
            r[RED], r[GREEN], r[BLUE], r[DEPTH] = colors[i, 0], colors[i, 1], colors[i, 2], z
            # a shade too wide, so that rounding can never drop a pixel that the lane test would draw
            r[REACH_X], r[REACH_Y] = 1.0002 * reach_x + 1e-3, 1.0002 * reach_y + 1e-3
            r[SLANT_X] = ab / aa * reach_x
            r[CUT] = 1.0004 * cut + 1e-4
            r[INVERSE_DET] = 1 / det
    return bad.sum()


@njit(cache=True, parallel=True)
def project_backward(
    means, axes, opacities, view, K, width, height, antialias, chunks, radii, partial, camera, upstream
):  # fmt: skip
    """Turn the blend's sums partial [threads,N,16] into gradients.

    Fills upstream = (means [N,3], axes [N,3,3], opacities [N], colors [N,3], screen [N,2], screen_abs [layers,N,2]) and
    returns the gradient of view if `camera`, else zeros, in parts [chunks,4,4]; rows that were not drawn get 0.
    """
    d_means, d_axes, d_opacities, d_colors, d_screen, d_screen_abs = upstream
    n = len(means)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    blur = PIXEL if antialias else BLUR
    d_views = np.zeros((chunks, 4, 4))
    for chunk in prange(chunks):
        s, d_view = np.empty(ROW), d_views[chunk]
        for i in range(chunk * n // chunks, (chunk + 1) * n // chunks):
            if radii[i] == 0:
                d_means[i], d_axes[i], d_opacities[i], d_colors[i], d_screen[i], d_screen_abs[:, i] = 0, 0, 0, 0, 0, 0
                continue
            for c in range(ROW):
                s[c] = 0
                for thread in range(len(partial)):
                    s[c] += partial[thread, i, c]
            x, y, z = _local(view, means, i, 0), _local(view, means, i, 1), _local(view, means, i, 2)
            u, v = _clamped(x / z, fx, cx, width), _clamped(y / z, fy, cy, height)
            forward = _turned(view, axes, i, 2)
            a = _plus(fx / z, _turned(view, axes, i, 0), -fx / z * u, forward)
            b = _plus(fy / z, _turned(view, axes, i, 1), -fy / z * v, forward)
            sharp, aa, bb, ab = _sharp(a, b), _dot(a, a) + blur, _dot(b, b) + blur, _dot(a, b)
            det = sharp + blur * (aa + bb - blur)
            A, slope, C = bb / det, -ab / bb, 1 / bb
            d_px, d_py = A * s[GU], A * slope * s[GU] + C * s[GY]
            # of A = 1 / (aa - ab^2 / bb), slope and C, from -1/2 sum g u^2, -A sum g u dy and -1/2 sum g dy^2
            e, f = A * A * s[GUU], A * C * s[GUY]
            d_aa, d_ab, d_bb = 0.5 * e, slope * e + f, 0.5 * (slope * slope * e + C * C * s[GYY]) + slope * f
            d_opacity = s[G] / opacities[i]  # alpha is proportional to opacity
            if antialias and sharp > COMPENSATION_MIN**2 * det:
                # log of the compensation = (log sharp - log det) / 2
                d_log = 0.5 * s[G]
                d_aa += d_log * ((bb - blur) / sharp - bb / det)
                d_bb += d_log * ((aa - blur) / sharp - aa / det)
                d_ab += d_log * (-2 * ab / sharp + 2 * ab / det)
            ga, gb = _plus(2 * d_aa, a, d_ab, b), _plus(2 * d_bb, b, d_ab, a)
            p, q = fx / z, fy / z
            t0, t1 = (p * ga[0], p * ga[1], p * ga[2]), (q * gb[0], q * gb[1], q * gb[2])
            t2 = _plus(-u, t0, -v, t1)
            du, dv = -_dot(forward, t0), -_dot(forward, t1)
            dx, dy = d_px * fx / z, d_py * fy / z
            dz = s[G_DEPTH] - (_dot(ga, a) + _dot(gb, b)) / z - (dx * x + dy * y) / z
            if u == x / z:
                dx += du / z
                dz -= du * x / (z * z)
            if v == y / z:
                dy += dv / z
                dz -= dv * y / (z * z)
            for c in range(3):
                d_means[i, c] = view[0, c] * dx + view[1, c] * dy + view[2, c] * dz
                row = _plus(view[0, c], t0, view[1, c], t1)
                d_axes[i, c, 0] = row[0] + view[2, c] * t2[0]
                d_axes[i, c, 1] = row[1] + view[2, c] * t2[1]
                d_axes[i, c, 2] = row[2] + view[2, c] * t2[2]
            if camera:
                for c in range(3):
                    m0, m1, m2 = np.float64(axes[i, c, 0]), np.float64(axes[i, c, 1]), np.float64(axes[i, c, 2])
                    d_view[0, c] += dx * means[i, c] + t0[0] * m0 + t0[1] * m1 + t0[2] * m2
                    d_view[1, c] += dy * means[i, c] + t1[0] * m0 + t1[1] * m1 + t1[2] * m2
                    d_view[2, c] += dz * means[i, c] + t2[0] * m0 + t2[1] * m1 + t2[2] * m2
                d_view[0, 3] += dx
                d_view[1, 3] += dy
                d_view[2, 3] += dz
            d_opacities[i] = d_opacity
            d_colors[i, 0], d_colors[i, 1], d_colors[i, 2] = s[G_RED], s[G_GREEN], s[G_BLUE]
            d_screen[i, 0], d_screen[i, 1] = d_px, d_py
            for layer in range(len(d_screen_abs)):
                d_screen_abs[layer, i, 0], d_screen_abs[layer, i, 1] = s[ABS + 2 * layer], s[ABS + 2 * layer + 1]
    return d_views


@njit(cache=True, parallel=True)
def clear(sums):
    """Zeros, row by row on the threads that will add to them."""
    for row in prange(len(sums)):
        sums[row] = 0


@njit(cache=True)
def depth_order(records, radii):
    """Rows that are drawn, nearest first, ties by row: a radix sort of the bits of positive float32 depths."""
    count = 0
    for i in range(len(radii)):
        count += radii[i] > 0
    order, keys = np.empty(count, np.int32), np.empty(count, np.uint32)
    bits = np.empty(1, np.float32)
    k = 0
    for i in range(len(radii)):
        if radii[i] > 0:
            bits[0] = records[i, DEPTH]
            order[k], keys[k] = i, bits.view(np.uint32)[0]
            k += 1
    order2, keys2 = np.empty_like(order), np.empty_like(keys)
    for shift in (0, 11, 22):
        start = np.zeros(2049, np.int64)
        for k in range(count):
            start[((keys[k] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for d in range(2048):
            start[d + 1] += start[d]
        for k in range(count):
            d = (keys[k] >> np.uint32(shift)) & np.uint32(2047)
            order2[start[d]], keys2[start[d]] = order[k], keys[k]
            start[d] += 1
        order, order2, keys, keys2 = order2, order, keys2, keys
    return order


@njit(cache=True, parallel=True)
def axes_forward(quats, scales, chunks, axes):
    """axes [N,3,3] = R(q / |q|) diag(scales)."""
    n = len(quats)
    for chunk in prange(chunks):
        for i in range(chunk * n // chunks, (chunk + 1) * n // chunks):
            w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            largest = max(abs(w), abs(x), abs(y), abs(z))
            if not 1e-15 < largest < 1e15:  # squares would leave float32
                w, x, y, z = w / largest, x / largest, y / largest, z / largest
            k = np.float32(2) / (w * w + x * x + y * y + z * z)
            s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
            one = np.float32(1)
            axes[i, 0, 0], axes[i, 0, 1] = (one - k * (y * y + z * z)) * s0, k * (x * y - w * z) * s1
            axes[i, 0, 2], axes[i, 1, 0] = k * (x * z + w * y) * s2, k * (x * y + w * z) * s0
            axes[i, 1, 1], axes[i, 1, 2] = (one - k * (x * x + z * z)) * s1, k * (y * z - w * x) * s2
            axes[i, 2, 0], axes[i, 2, 1] = k * (x * z - w * y) * s0, k * (y * z + w * x) * s1
            axes[i, 2, 2] = (one - k * (x * x + y * y)) * s2


@njit(cache=True, parallel=True)
def axes_backward(quats, scales, axes, d_axes, chunks, d_quats, d_scales):
    """Gradients of `axes_forward` in quats and scales."""
    n = len(quats)
    for chunk in prange(chunks):
        g = np.empty((3, 3))
        for i in range(chunk * n // chunks, (chunk + 1) * n // chunks):
            length = math.sqrt(
                np.float64(quats[i, 0]) ** 2 + np.float64(quats[i, 1]) ** 2 + np.float64(quats[i, 2]) ** 2
                + np.float64(quats[i, 3]) ** 2
            )  # fmt: skip
            w, x, y, z = quats[i, 0] / length, quats[i, 1] / length, quats[i, 2] / length, quats[i, 3] / length
            for c in range(3):
                d_scales[i, c] = 0
                for r in range(3):
                    g[r, c] = d_axes[i, r, c] * scales[i, c]
            R00, R01, R02 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
            R10, R11, R12 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
            R20, R21, R22 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
            d_scales[i, 0] = R00 * d_axes[i, 0, 0] + R10 * d_axes[i, 1, 0] + R20 * d_axes[i, 2, 0]
            d_scales[i, 1] = R01 * d_axes[i, 0, 1] + R11 * d_axes[i, 1, 1] + R21 * d_axes[i, 2, 1]
            d_scales[i, 2] = R02 * d_axes[i, 0, 2] + R12 * d_axes[i, 1, 2] + R22 * d_axes[i, 2, 2]
            gw = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
            gx = 2 * (w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]))
            gx -= 4 * x * (g[1, 1] + g[2, 2])
            gy = 2 * (w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]))
            gy -= 4 * y * (g[0, 0] + g[2, 2])
            gz = 2 * (w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]))
            gz -= 4 * z * (g[0, 0] + g[1, 1])
            along = w * gw + x * gx + y * gy + z * gz  # the length of a quaternion has no effect
            d_quats[i, 0], d_quats[i, 1] = (gw - along * w) / length, (gx - along * x) / length
            d_quats[i, 2], d_quats[i, 3] = (gy - along * y) / length, (gz - along * z) / length

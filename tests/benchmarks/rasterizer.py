"""How fast the rasterizer is: the CPU kernel against a naive kernel and the torch reference, forward and backward.

    python -m tests.benchmarks.rasterizer [--repeats 9] [--json out.json]

Times are wall-clock medians of one process, with the makers taking turns. The naive kernel is what one would write first:
a thread a tile, a loop over pixels, `math.exp`, a gradient buffer a thread. It is given projection, depth order and
tile lists for nothing, so the ratio is on the low side. Milliseconds belong to a machine and its load; ratios travel.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the engine does

import argparse
import json
import math
import platform
import statistics
import time
from pathlib import Path

import numpy as np
import torch
from numba import njit, prange

from stages.avatar.rasterize import cpu, kernels, reference
from stages.avatar.rasterize.rendering import ALPHA_MAX, ALPHA_MIN, T_STOP

NAMES = ("means", "quats", "scales", "opacities", "colors")
SCENES = {  # Gaussians, width, height, mean layers, share of the picture they lie in, with the torch reference
    "tiny": (600, 96, 96, 20, 1.0, True),
    "20k 256x256": (20_000, 256, 256, 40, 1.0, False),
    "27k person 480x864": (27_000, 480, 864, 40, 0.25, False),
    "100k 480x864": (100_000, 480, 864, 40, 1.0, False),
    "200k 1280x720": (200_000, 1280, 720, 40, 1.0, False),
}


def scene(n, width, height, layers, share, seed=0):
    """Random Gaussians, most of them small and some large, whose areas (3 sigma) cover each pixel about `layers` times."""
    g = torch.Generator().manual_seed(seed)
    focal, depth = 0.9 * max(width, height), 2 + 8 * torch.rand(n, generator=g)
    size = torch.tensor([width, height])
    pixels = size / 2 + (torch.rand(n, 2, generator=g) - 0.5) * size * math.sqrt(share)
    means = torch.cat([(pixels - size / 2) / focal * depth[:, None], depth[:, None]], 1)
    sigma = math.sqrt(width * height * share * layers / (9 * math.pi * n))
    scales = 0.5 * (sigma * depth / focal)[:, None] * torch.exp(0.9 * torch.randn(n, 3, generator=g))
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    opacities = 0.05 + 0.94 * torch.rand(n, generator=g)
    parts = (means, torch.randn(n, 4, generator=g), scales, opacities, torch.rand(n, 3, generator=g))
    return parts, K, torch.rand(height, width, 3, generator=g)


@njit(cache=True, inline="always")
def _alpha(r, x, y):
    dx, dy = x + 0.5 - r[kernels.X], y + 0.5 - r[kernels.Y]
    power = (r[kernels.QA] * dx * dx + r[kernels.QB] * dx * dy + r[kernels.QC] * dy * dy) / kernels.LOG2E
    return dx, dy, r[kernels.SHARE] * math.exp(-max(power, 0.0))


@njit(cache=True, parallel=True)
def naive_forward(starts, rows, records, width, height, image, finals, lasts):
    """Blend pixel by pixel over black."""
    across, tile_size = (width + kernels.TILE - 1) // kernels.TILE, kernels.TILE
    for tile in prange(len(starts) - 1):
        left, top = tile % across * tile_size, tile // across * tile_size
        for y in range(top, min(top + tile_size, height)):
            for x in range(left, min(left + tile_size, width)):
                light, last = 1.0, -1
                red, green, blue = 0.0, 0.0, 0.0
                for k in range(starts[tile], starts[tile + 1]):
                    r = records[rows[k]]
                    _, _, alpha = _alpha(r, x, y)
                    if alpha < ALPHA_MIN:
                        continue
                    alpha = min(alpha, ALPHA_MAX)
                    if light * (1 - alpha) <= T_STOP:
                        break
                    red += alpha * light * r[kernels.RED]
                    green += alpha * light * r[kernels.GREEN]
                    blue += alpha * light * r[kernels.BLUE]
                    light *= 1 - alpha
                    last = k
                image[y, x, 0], image[y, x, 1], image[y, x, 2] = red, green, blue
                finals[y, x], lasts[y, x] = light, last


@njit(cache=True, parallel=True)
def naive_backward(starts, rows, records, width, height, finals, lasts, v_image, threads, sums):
    """dL/d(x, y, three moments, log opacity, red, green, blue) of each Gaussian into sums [threads,N,9]."""
    across, tile_size = (width + kernels.TILE - 1) // kernels.TILE, kernels.TILE
    for thread in prange(threads):
        sums[thread] = 0
        for tile in range(thread, len(starts) - 1, threads):
            left, top = tile % across * tile_size, tile // across * tile_size
            for y in range(top, min(top + tile_size, height)):
                for x in range(left, min(left + tile_size, width)):
                    light, behind, v = finals[y, x], 0.0, v_image[y, x]
                    for k in range(lasts[y, x], starts[tile] - 1, -1):
                        i = rows[k]
                        r, s = records[i], sums[thread, i]
                        dx, dy, full = _alpha(r, x, y)
                        if full < ALPHA_MIN:
                            continue
                        alpha = min(full, ALPHA_MAX)
                        light /= 1 - alpha
                        value = v[0] * r[kernels.RED] + v[1] * r[kernels.GREEN] + v[2] * r[kernels.BLUE]
                        g = alpha * (value * light - behind / (1 - alpha)) if full < ALPHA_MAX else 0.0
                        behind += value * alpha * light
                        s[0] += g * dx
                        s[1] += g * dy
                        s[2] += g * dx * dx
                        s[3] += g * dx * dy
                        s[4] += g * dy * dy
                        s[5] += g
                        s[6] += alpha * light * v[0]
                        s[7] += alpha * light * v[1]
                        s[8] += alpha * light * v[2]


def naive_maker(parts, K, width, height, v_image):
    """(forward, backward) of the naive kernel, everything before the blend done beforehand."""
    means, quats, scales, opacities, colors = parts
    axes = cpu.gaussian_axes(quats, scales)
    n, threads = len(means), torch.get_num_threads()
    records = np.empty((n, 16), np.float32)
    radii = np.empty(n, np.float32)
    arrays = [t.numpy() for t in (means, axes, opacities, colors)]
    kernels.project(
        *arrays, np.eye(4), K.numpy().astype(float), width, height, False, 0.01, cpu.CHUNKS, records,
        np.empty((n, 2), np.float32), radii
    )  # fmt: skip
    lists = kernels.tile_lists(kernels.depth_order(records, radii), records, width, height, cpu.CHUNKS)
    image, finals = np.empty((height, width, 3), np.float32), np.empty((height, width), np.float32)
    lasts, sums, v = np.empty((height, width), np.int64), np.empty((threads, n, 9), np.float32), v_image.numpy()

    def forward():
        naive_forward(*lists, records, width, height, image, finals, lasts)
        return image

    def backward():
        naive_backward(*lists, records, width, height, finals, lasts, v, threads, sums)
        total = sums.sum(0)
        return torch.from_numpy(total[:, 6:])

    return forward, backward


def torch_maker(maker, dtype, parts, K, width, height, v_image):
    """(forward, backward) of a maker with the rasterizer's signature."""
    leaves = [p.to(dtype, copy=True).requires_grad_() for p in parts]
    view, K, v_image = torch.eye(4, dtype=dtype), K.to(dtype), v_image.to(dtype)
    drawn = []

    def forward():
        means, quats, scales, opacities, colors = leaves
        axes = maker.gaussian_axes(quats, scales)
        drawn[:] = [maker.rasterize(means, axes, opacities, colors, view, K, width, height)]
        return drawn[0].image.detach().numpy()

    def backward():
        for leaf in leaves:
            leaf.grad = None
        drawn[0].image.backward(v_image)
        return leaves[4].grad

    return forward, backward, leaves


def clock(work) -> float:
    start = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - start)


def distance(a, b) -> float:
    """Relative L2."""
    return ((a.double() - b.double()).norm() / b.double().norm()).item()


def measure(name: str, repeats: int) -> dict:
    """Milliseconds of every maker on one scene, medians and minima, after a first call that compiles."""
    n, width, height, layers, share, dense = SCENES[name]
    parts, K, v_image = scene(n, width, height, layers, share)
    size = (parts, K, width, height, v_image)
    *ours, leaves = torch_maker(cpu, torch.float32, *size)
    makers = {"kernel": ours, "naive": naive_maker(*size)}
    if dense:
        makers["torch"] = torch_maker(reference, torch.float32, *size)[:2]
    images = {maker: (forward(), backward()) for maker, (forward, backward) in makers.items()}
    for maker, (image, grad) in images.items():
        off, grad_off = np.abs(image - images["kernel"][0]), distance(grad, images["kernel"][1])
        assert np.quantile(off, 0.999) < 1e-3 and grad_off < 1e-3, f"{maker} draws something else on {name}"
    times = {maker: ([], []) for maker in makers}
    for turn in range(repeats):
        for maker, pair in makers.items():
            if maker == "kernel" or turn < max(3, repeats // 3):  # the slow ones vary less
                for kept, work in zip(times[maker], pair):
                    kept.append(clock(work))
    row = {"scene": name, "gaussians": n, "width": width, "height": height}
    for maker, pair in times.items():
        row[maker] = {
            way: {"median_ms": statistics.median(kept), "min_ms": min(kept), "repeats": len(kept)}
            for way, kept in zip(("forward", "backward"), pair)
        }
    if dense:
        true_forward, true_backward, true_leaves = torch_maker(reference, torch.float64, *size)
        ours[0]()
        ours[1]()
        off = np.abs(ours[0]() - true_forward())
        true_backward()
        row["error_against_float64"] = {"image_max": float(off.max()), "image_median": float(np.median(off))} | {
            part: distance(a.grad, b.grad) for part, a, b in zip(NAMES, leaves, true_leaves)
        }
    return row


def machine() -> dict:
    """What the milliseconds belong to."""
    cpuinfo = Path("/proc/cpuinfo")
    models = [line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def main() -> None:
    """Print the table; write it as JSON too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES))
    options = parser.parse_args()
    host = machine()
    print(f"{host['processor']}, {host['threads']} threads of {host['cores']} cores, load {host['load'][0]:.1f}")
    print(f"{'median ms':<20}{'kernel':>16}{'naive':>18}{'torch':>16}   naive / kernel")
    rows = []
    for name in options.scenes:
        row = measure(name, options.repeats)
        rows.append(row)
        both = {
            maker: [row[maker][way]["median_ms"] for way in ("forward", "backward")]
            for maker in ("kernel", "naive", "torch")
            if maker in row
        }
        cells = "".join(
            f"{both[m][0]:>10.1f} {both[m][1]:>7.1f}" if m in both else f"{'-':>18}"
            for m in ("kernel", "naive", "torch")
        )
        print(f"{name:<20}{cells}   {sum(both['naive']) / sum(both['kernel']):>5.1f}x", flush=True)
        if "error_against_float64" in row:
            errors = row["error_against_float64"]
            print("  against float64: " + ", ".join(f"{part} {error:.1e}" for part, error in errors.items()))
    if options.json:
        options.json.write_text(json.dumps({"machine": host, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()

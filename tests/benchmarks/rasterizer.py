"""How fast the CPU rasterizer is, forward and backward, against what else draws Gaussians on a CPU.

    python -m tests.benchmarks.rasterizer [--quick] [--garden POINTS.npz] [--work work/kitchen/default] [--json out.json]

Times are wall-clock medians of one process, with the makers taking turns, on all threads and on one. Ours is timed end
to end: projection, depth order, tile lists and blend, back to the gradients of means, quaternions, scales, opacities and
colours. The naive kernels (`naive`: Numba, `warp`: NVIDIA Warp, which has one thread on a CPU) get projection, order and
lists for nothing and stop at the screen, so their ratios are on the low side. `torch` is our reference, which looks at
every Gaussian from every pixel, and `compiled` its blend through torch.compile, again with all before the blend for
nothing: only a tiny scene is within their reach.
A pair is a Gaussian and a pixel it counts in. Milliseconds belong to a machine and its load; ratios travel.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from stages.avatar import rasterize as ours
from stages.avatar.rasterize import Gaussians, reference
from tests.benchmarks.host import all_threads, clock, fma_peak, machine, summary, use_threads
from tests.benchmarks.naive import Naive, Workload, project
from tests.benchmarks.naive_compiled import NaiveCompiled
from tests.benchmarks.workloads import garden_works, learned_work, random_work

PARTS = ("means", "quats", "scales", "opacities", "colors")
WAYS = ("forward", "backward", "both")
MAKERS = ("ours", "naive", "warp", "torch", "compiled")
TINY = (600, 96, 96, 20)
QUICK = "20k 256x256"
SCENES = {  # Gaussians, width, height, layers
    QUICK: (20_000, 256, 256, 40),
    "20k 640x360": (20_000, 640, 360, 30),
    "20k 1280x720": (20_000, 1280, 720, 20),
    "200k 256x256": (200_000, 256, 256, 60),
    "200k 640x360": (200_000, 640, 360, 40),
    "200k 1280x720": (200_000, 1280, 720, 40),
}
FLOPS = {"forward": 33, "backward": 58}  # of one pair: exponent, blend, and the moments of its gradient
REFUSE = "not measured, as they refuse a CPU: gsplat, gswarp, splax, taichi-splatting"


class Torch:
    """A maker with the signature of `rasterize` on one workload."""

    def __init__(self, work: Workload, draw, axes, dtype: torch.dtype = torch.float32):
        self.leaves = [part.to(dtype, copy=True).requires_grad_() for part in work.parts]
        self.camera = work.camera.to(self.leaves[0])
        self.v_image, self.draw, self.axes = work.v_image.to(dtype), draw, axes

    def forward(self) -> np.ndarray:
        """The image [H,W,3]."""
        means, quats, scales, opacities, colors = self.leaves
        (self.drawn,) = self.draw(Gaussians(means, self.axes(quats, scales), opacities, colors), self.camera)
        return self.drawn.image.detach().numpy()

    def backward(self) -> None:
        """Gradients of `forward`'s image in all leaves."""
        for leaf in self.leaves:
            leaf.grad = None
        self.drawn.image.backward(self.v_image)

    def gradients(self) -> tuple[np.ndarray, np.ndarray]:
        """Of means2d [N,2] and colors [N,3]."""
        return self.drawn.screen_grad.numpy(), self.leaves[4].grad.numpy()


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Relative L2."""
    return float(np.linalg.norm(a.astype(np.float64) - b) / np.linalg.norm(b.astype(np.float64)))


def agree(name: str, image: np.ndarray, colors: np.ndarray, like: np.ndarray, like_colors: np.ndarray) -> None:
    """AssertionError unless a maker draws what ours draws, but for the odd pixel at a threshold."""
    off, off_colors = np.quantile(np.abs(image - like), 0.999), distance(colors, like_colors)
    assert off < 1e-3 and off_colors < 1e-3, f"{name} draws something else: {off:.1e}, {off_colors:.1e}"


def makers(work: Workload, dense: bool) -> tuple[dict[str, object], dict[str, str], int]:
    """The makers that agree with ours after a first call each, why the others do not run, and how many pairs there are."""
    screen = project(work)
    found, absent = {"ours": Torch(work, ours.rasterize, ours.gaussian_axes), "naive": Naive(work, screen)}, {}
    try:
        from tests.benchmarks.naive_warp import NaiveWarp
    except ImportError:
        absent["warp"] = "not installed"
    else:
        found["warp"] = NaiveWarp(work, screen)
    if dense:
        found["torch"] = Torch(work, reference.rasterize, reference.gaussian_axes)
        found["compiled"] = NaiveCompiled(work, screen)
    images = {}
    for name, maker in list(found.items()):
        try:
            images[name] = maker.forward().copy()
            maker.backward()
        except Exception as error:
            if name != "compiled":
                raise
            absent[name] = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            del found[name]
    like = images["ours"], found["ours"].gradients()[1]
    for name, maker in found.items():
        agree(name, images[name], maker.gradients()[1], *like)
    return found, absent, int(found["naive"].pairs.sum())


def measure(work: Workload, repeats: int, threads: int, dense: bool = False) -> dict:
    """Milliseconds of every maker on one workload and so many threads."""
    use_threads(threads)
    found, absent, pairs = makers(work, dense)
    times = {name: {way: [] for way in WAYS} for name in found}
    for turn in range(repeats):
        for name, maker in found.items():
            if name == "ours" or turn < max(3, repeats // 3):  # the slow ones vary less
                forward, backward = clock(maker.forward), clock(maker.backward)
                for way, taken in zip(WAYS, (forward, backward, forward + backward)):
                    times[name][way].append(taken)
    kept = {name: {way: summary(taken) for way, taken in ways.items()} for name, ways in times.items()}
    return {"threads": threads, "pairs": pairs, "ms": kept, "absent": absent}


def errors(work: Workload) -> dict[str, float]:
    """How far ours is from the reference in float64: image, and the gradient of each part (relative L2)."""
    one = Torch(work, ours.rasterize, ours.gaussian_axes)
    true = Torch(work, reference.rasterize, reference.gaussian_axes, torch.float64)
    off = np.abs(one.forward() - true.forward())
    one.backward()
    true.backward()
    grads = {p: distance(a.grad.numpy(), b.grad.numpy()) for p, a, b in zip(PARTS, one.leaves, true.leaves)}
    return {"image max": float(off.max()), "image median": float(np.median(off))} | grads


def line(name: str, row: dict) -> str:
    """One workload's medians, with the quartiles of ours and how many times as long the others take."""
    ms, own = row["ms"], row["ms"]["ours"]["both"]
    cells = f"{name:<16}"
    for maker in MAKERS:
        if maker in ms:
            way = [ms[maker][w]["median"] for w in WAYS]
            more = f"[{own['q1']:.1f}-{own['q3']:.1f}]" if maker == "ours" else f"{way[2] / own['median']:.1f}x"
            cells += f"{way[0]:>9.1f}{way[1]:>9.1f} {more:<15}"
        else:
            cells += f"{row['absent'].get(maker, '-'):>18.32}{'':<16}"[:34]
    return cells


def rates(name: str, work: Workload, one: dict, many: dict, peaks: dict[int, float]) -> str:
    """One workload's throughput: pairs, speed-up by threads, pairs a second and the share of the measured peak."""
    cells = f"{name:<16}{one['pairs'] / 1e6:>8.2f}{one['pairs'] / (work.camera.width * work.camera.height):>8.1f}"
    for way in ("forward", "backward"):
        cells += f"{one['ms']['ours'][way]['median'] / many['ms']['ours'][way]['median']:>10.2f}"
    for row in (many, one):
        for way, flops in FLOPS.items():
            rate = row["pairs"] / row["ms"]["ours"][way]["median"] * 1e3
            cells += f"{rate / 1e9:>10.3f} {100 * rate * flops / peaks[row['threads']]:>4.1f}%"
    return cells


def main() -> None:
    """Print the tables; write everything as JSON too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--quick", action="store_true", help="one random scene, three repeats")
    parser.add_argument("--garden", type=Path, help="npz of coloured points with cameras")
    parser.add_argument("--work", type=Path, help="folder of a finished pipeline")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    works = {name: random_work(*SCENES[name]) for name in ([QUICK] if asked.quick else SCENES)}
    if not asked.quick:
        works = {"tiny": random_work(*TINY)} | works
    if asked.garden:
        works |= garden_works(asked.garden)
    if asked.work:
        works["finished"] = learned_work(asked.work)
    repeats, counts = 3 if asked.quick else asked.repeats, sorted({all_threads(), 1}, reverse=True)
    host, peaks = machine(), {threads: fma_peak(threads) for threads in counts}
    print(f"{host['processor']}, {host['cores']} cores, load {host['load'][0]:.1f}; {REFUSE}")
    rows: dict[str, dict[int, dict]] = {name: {} for name in works}
    for threads in counts:
        print(f"\nmedian ms, forward and backward, {threads} thread{'s'[: threads > 1]} (warp: always 1)")
        print(f"{'':<16}" + "".join(f"{maker:>18} {'':<15}" for maker in MAKERS))
        for name, work in works.items():
            rows[name][threads] = measure(work, repeats, threads, dense=name == "tiny")
            print(line(name, rows[name][threads]), flush=True)
    gigaflops = ", ".join(f"{peak / 1e9:.0f} on {threads}" for threads, peak in peaks.items())
    print(f"\nours: Gpair/s end to end, and its share of the FMA peak measured here (GFLOP/s by threads: {gigaflops})")
    print(
        f"{FLOPS['forward']} operations a pair forward, {FLOPS['backward']} backward; the rest of the work counts as 0"
    )
    heads = [f"{way} {threads}" for threads in (counts[0], 1) for way in ("fwd", "bwd")]
    print(f"{'':<16}{'Mpairs':>8}{'/pixel':>8}{'fwd x':>10}{'bwd x':>10}" + "".join(f"{head:>16}" for head in heads))
    for name, work in works.items():
        print(rates(name, work, rows[name][1], rows[name][counts[0]], peaks))
    off = {}
    if not asked.quick:
        print("\nours against the reference in float64")
        off = {"tiny": errors(works["tiny"]), "needles 100:1": errors(random_work(*TINY, needles=True))}
        for name, kinds in off.items():
            print(f"{name:<16}" + ", ".join(f"{kind} {error:.1e}" for kind, error in kinds.items()))
    if asked.json:
        facts = {
            name: {"gaussians": len(w.parts[0]), "size": [w.camera.width, w.camera.height]} for name, w in works.items()
        }
        scenes = {name: facts[name] | {"runs": list(runs.values())} for name, runs in rows.items()}
        result = {"machine": host, "fma_peak_flops": peaks, "scenes": scenes, "error_against_float64": off}
        asked.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()

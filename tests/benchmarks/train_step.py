"""Where the time of a training step goes, by part, for several sizes of person and scene, at full resolution.

    python -m tests.benchmarks.train_step work/kitchen/default [--repeats 24] [--json out.json]

The argument is the folder of a pipeline that has run. Person and settings are as before the first step; the scene is the
trained one, its Gaussians repeated or thinned out to the number asked for. Nothing is densified meanwhile, and there is
no perceptual term. The time of a part is exclusive: without the parts that run inside it. Each size has a process of its
own, whose peak memory is reported.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import multiprocessing
import resource
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch

from stages import train
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.measures import ssim
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import blend, cpu, gaussian_axes
from stages.avatar.rasterize import projection as kernels
from stages.avatar.splats import compose
from stages.avatar.splats.gaussians import Splats
from stages.formats.clip import load_clip
from stages.formats.splats import read_scene
from stages.records import Scene
from stages.training.beginning.start import Task, build
from stages.training.step import densify, fit, layers, losses, person
from tests.benchmarks.host import machine, summary
from tests.benchmarks.workloads import surveyed

# points of the person and Gaussians of the scene
SIZES = ((27_500, 50_000), (27_500, 60_000), (27_500, 200_000), (110_000, 50_000), (110_000, 200_000))


def timed_parts(joint: fit.Fit) -> tuple[tuple[str, object, str], ...]:
    """Name, owner and attribute of what is timed; only what Python calls, as kernels call kernels directly."""
    return (
        ("decode", person.PersonLearner, "_decoded"),
        ("own corrections", person.PersonLearner, "resting"),
        ("own corrections, step", person.PersonLearner, "learn_own"),
        ("decode, backward", person.PersonLearner, "learn"),
        ("pose (LBS)", person.Learning, "_posed"),
        ("pose (LBS)", FrameEffects, "lit"),
        ("scene activations", SceneModel, "splats"),
        ("SH colours", Splats, "colors"),
        ("projection", kernels, "project"),
        ("depth order, tile lists", kernels, "depth_order"),
        ("depth order, tile lists", cpu, "tile_lists"),
        ("blend", blend, "draw"),
        ("blend, backward", blend, "draw_backward"),
        ("projection, backward", kernels, "project_backward"),
        ("scene activations, backward", kernels, "axes_backward"),
        ("drawing, other", compose, "rasterize"),
        ("SSIM", losses, "ssim"),
        ("SSIM, backward", ssim._Ssim, "backward"),
        ("other losses", losses, "photometric"),
        ("other losses", losses, "person_only"),
        ("other losses", losses, "outside_person"),
        ("other losses", losses, "skinning"),
        ("occluders", layers, "foreground_occluders"),
        ("effects", FrameEffects, "shade"),
        ("effects", person.PersonLearner, "casters_in"),
        ("effects", Clothing, "swing"),
        ("backward, other", torch.Tensor, "backward"),
        ("growth statistics", densify.Growth, "add"),
        ("optimiser, scene and frames", fit.Fit, "_apply"),
        ("optimiser, person", joint.adam["person 1"], "step"),
        ("nearest body vertices", person.PersonLearner, "_reference"),
        ("rest", fit.Fit, "advance"),
    )


class Stopwatch:
    """Seconds by part, each without the parts that ran inside it."""

    def __init__(self):
        self.seconds: dict[str, float] = defaultdict(float)
        self.inside: list[float] = []

    def timed(self, part: str, work: Callable) -> Callable:
        """`work`, whose time counts for `part`."""

        def measured(*args, **more):
            self.inside.append(0.0)
            start = time.perf_counter()
            try:
                return work(*args, **more)
            finally:
                taken = time.perf_counter() - start
                self.seconds[part] += taken - self.inside.pop()
                if self.inside:
                    self.inside[-1] += taken

        return measured

    def watch(self, parts: Iterable[tuple[str, object, str]]) -> None:
        """Replace each attribute of `parts`, rows of (name, owner, attribute), by its timed self, for good."""
        for part, owner, name in parts:
            timed = self.timed(part, getattr(owner, name))
            is_static = isinstance(inspect.getattr_static(owner, name), staticmethod)
            setattr(owner, name, staticmethod(timed) if is_static else timed)


def resized(scene: Scene, count: int, rng: np.random.Generator) -> Scene:
    """The scene with `count` Gaussians of `len(scene) / count` of their volume: split into children, or thinned out."""
    rows = np.concatenate([rng.permutation(len(scene)) for _ in range(math.ceil(count / len(scene)))])[:count]
    shrink = (len(scene) / count) ** (1 / 3)
    means, quats, scales, opacities, sh0, shN = (
        getattr(scene, name)[rows] for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
    )
    apart = math.sqrt(max(0.0, 1 - shrink**2))  # children together are as wide as their parent
    axes = gaussian_axes(torch.from_numpy(quats), torch.from_numpy(scales)).numpy()
    means = means + apart * (axes @ rng.standard_normal((count, 3, 1)))[..., 0]
    return Scene(means, quats, shrink * scales, opacities, sh0, shN)


def model(scene: Scene, extent: float) -> SceneModel:
    """The scene to train on."""
    tensors = {name: torch.as_tensor(getattr(scene, name), dtype=torch.float32) for name in ("means", "quats", "sh0")}
    tensors["shN"] = torch.as_tensor(scene.shN, dtype=torch.float32)
    tensors["log_scales"] = torch.as_tensor(scene.scales, dtype=torch.float32).log()
    tensors["logit_opacities"] = torch.as_tensor(scene.opacities, dtype=torch.float32).logit(1e-6)
    degree = math.isqrt(scene.shN.shape[1] + 1) - 1
    trained = SceneModel(tensors["means"], torch.zeros_like(tensors["means"]), degree, extent)
    with torch.no_grad():
        for name, values in tensors.items():
            getattr(trained, name).copy_(values)
    return trained


def prepared(folder: Path, points: int, count: int) -> fit.Fit:
    """The joint model of one size, at the first step of full resolution."""
    clip = load_clip(folder / "sfm", folder / "smpl")
    decisions, starts = surveyed(folder)
    fresh = build(Task([clip], train.Params(human_points=points), decisions | {"scene": True}, starts), print)
    scene = resized(read_scene(folder / "train" / "scene.npz"), count, np.random.default_rng(0))
    (who,) = fresh.people
    starting = person.Starting(who.body, who.human)
    parts = (fresh.full, fresh.train, [starting], model(scene, fresh.options.extent))
    generator = torch.Generator().manual_seed(0)
    joint = fit.Fit(*parts, fresh.params, fresh.options, generator, effects=fresh.effects)
    every = joint.params.views_per_decode
    joint.progress.step = math.ceil(joint.half_until * joint.params.steps / every) * every
    joint.densifier.grow = lambda *_: None
    return joint


def measure(folder: Path, points: int, count: int, repeats: int) -> dict:
    """Milliseconds of a step, in all and by part, over at least `repeats` steps after those of one decode."""
    joint = prepared(folder, points, count)
    every = joint.params.views_per_decode
    for _ in range(every):
        joint.advance()
    watch, parts, totals = Stopwatch(), timed_parts(joint), []
    watch.watch(parts)
    for _ in range(math.ceil(repeats / every)):
        start = time.perf_counter()
        for _ in range(every):
            joint.advance()
        totals.append(1e3 * (time.perf_counter() - start) / every)
    steps = len(totals) * every
    return {
        "human": len(joint.people[0].human),
        "scene": len(joint.scene),
        "size": list(reversed(joint.full.masks.shape[1:])),
        "steps": steps,
        "ms": summary(totals),
        "mean_ms": sum(totals) / len(totals),
        "parts_ms": {part: 1e3 * watch.seconds[part] / steps for part in dict.fromkeys(p for p, _, _ in parts)},
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def table(rows: list[dict]) -> str:
    """Parts down, sizes across."""
    lines = [
        f"{'ms a step':<30}" + "".join(f"{r['human'] / 1e3:>9.0f}k+{r['scene'] / 1e3:.0f}k".rjust(16) for r in rows)
    ]
    for part in rows[0]["parts_ms"]:
        lines.append(f"{part:<30}" + "".join(f"{r['parts_ms'][part]:>16.1f}" for r in rows))
    lines.append(f"{'mean':<30}" + "".join(f"{r['mean_ms']:>16.1f}" for r in rows))
    lines.append(f"{'median':<30}" + "".join(f"{r['ms']['median']:>16.1f}" for r in rows))
    quartiles = (f"{r['ms']['q1']:.1f}-{r['ms']['q3']:.1f}" for r in rows)
    lines.append(f"{'quartiles':<30}" + "".join(f"{cell:>16}" for cell in quartiles))
    lines.append(f"{'peak memory (MiB)':<30}" + "".join(f"{r['peak_bytes'] / 2**20:>16.0f}" for r in rows))
    return "\n".join(lines)


def main() -> None:
    """Print the table; write it as JSON too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--repeats", type=int, default=24, help="steps of each size")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    host = machine() | {"threads": torch.get_num_threads()}
    spawn, rows = multiprocessing.get_context("spawn"), []
    for points, count in SIZES:
        with ProcessPoolExecutor(1, spawn) as alone:
            rows.append(alone.submit(measure, asked.folder, points, count, asked.repeats).result())
    width, height = rows[0]["size"]
    print(f"{host['processor']}, {host['threads']} threads, load {host['load'][0]:.1f}; {width}x{height} px")
    print(table(rows))
    if asked.json:
        asked.json.write_text(json.dumps({"machine": host, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()

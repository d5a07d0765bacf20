"""What each approximation in the hot path loses and saves: error against float64, dB after training, milliseconds.

    python -m tests.benchmarks.approximations work/kitchen/default [--steps 150] [--seeds 1] [--only NAME ...] [--json out.json]

The argument is the folder of a pipeline that has run. Each row is the code with one approximation made coarser, finer, or
taken out, in a copy of the tree with a cache of its own for compiled kernels. Against float64 are: "small", the largest
error of 600 Gaussians on 96x96 px, and "slopes", that of their gradients (relative L2), both without any cut; and
"decode", how far the networks put a Gaussian off after training, mm. "drawn" is the error of a trained picture against
the row `exact`, in dB. What sums in float32 cost is in tests/benchmarks/precision.py: there is no other kernel.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.tools.mutants import copy_tree

DRAWING, LANES = "stages/avatar/rasterize/rendering.py", "stages/avatar/kernels/lanes.py"
EXP2 = "polynomial = (1.32647273e-03, 9.67151299e-03, 5.55073358e-02, 2.40222424e-01, 6.93147004e-01, 1.0)"
SEXTIC = EXP2.replace(
    EXP2[EXP2.index("(") :],
    "(1.53532421e-04, 1.33988215e-03, 9.61843733e-03, 5.55033260e-02, 2.40226479e-01, 6.93147203e-01, 1.0)",
)  # relative error 2e-9 before rounding; the fifth degree has 9e-8
CUBIC = "polynomial = (5.500858e-02, 2.4221036e-01, 6.932829e-01, 1.0)"  # relative error at most 1.0e-4
STOP, CUT = "T_STOP = 1e-4", "ALPHA_MIN = 1 / 255"
BF16 = "FAST = bool("


class Case(NamedTuple):
    """A change of the code, or of train's settings: each (file, text, instead)."""

    edits: tuple[tuple[str, str, str], ...] = ()
    settings: tuple[tuple[str, Any], ...] = ()


def stop(at: float, *more: tuple[str, str, str]) -> Case:
    """Pixels are finished when less than `at` of the light would pass, where anything is drawn and in training."""
    return Case(((DRAWING, STOP, f"T_STOP = {at:g}"), *more))


CASES = {
    "exact": stop(1e-7, (DRAWING, CUT, "ALPHA_MIN = 1 / 4096"), (LANES, EXP2, SEXTIC)),
    "as it is": Case(),
    "early stop at 1e-6": stop(1e-6),
    "early stop at 1e-3": stop(1e-3),
    "early stop at 1e-2": stop(1e-2),
    "alpha from 1/1024": Case(((DRAWING, CUT, "ALPHA_MIN = 1 / 1024"),)),
    "alpha from 1/64": Case(((DRAWING, CUT, "ALPHA_MIN = 1 / 64"),)),
    "an exponential to 2e-9": Case(((LANES, EXP2, SEXTIC),)),
    "a cubic exponential": Case(((LANES, EXP2, CUBIC),)),
    "networks in float32": Case((("stages/avatar/model/decoders.py", BF16, "FAST = False and bool("),)),
    "LPIPS every 8th step": Case(settings=(("perceptual_every", 8),)),
    "LPIPS every 4th step": Case(settings=(("perceptual_every", 4),)),
    "LPIPS every 2nd step": Case(settings=(("perceptual_every", 2),)),
    "LPIPS every step": Case(settings=(("perceptual_every", 1),)),
}


def small_errors() -> dict[str, float]:
    """What 600 Gaussians are off the float64 reference without early stop and cut: their picture, and their gradients."""
    from stages.avatar.rasterize import Gaussians, Layer, cpu, reference
    from tests.benchmarks.rasterizer import distance
    from tests.benchmarks.workloads import random_work

    work = random_work(600, 96, 96, 20)

    def drawn(maker: Any, dtype: Any, layer: Layer) -> tuple[Any, list[Any]]:
        leaves = [part.detach().to(dtype).requires_grad_() for part in work.parts]
        means, quats, scales, opacities, colors = leaves
        gaussians = Gaussians(means, maker.gaussian_axes(quats, scales), opacities, colors)
        image = maker.rasterize(gaussians, work.camera.to(means), (layer,))[0].image
        image.backward(work.v_image.to(dtype))
        return image.detach(), [leaf.grad for leaf in leaves]

    image, slopes = drawn(cpu, work.camera.viewmat.dtype, Layer())
    reference.ALPHA_MIN, reference.T_STOP = 1e-12, 0.0
    true, true_slopes = drawn(reference, work.camera.viewmat.double().dtype, Layer())
    worst = max(distance(a.numpy(), b.numpy()) for a, b in zip(slopes, true_slopes, strict=True))
    return {"small": float((image - true).abs().max()), "slopes": worst}


def decode_error(human: Any) -> float:
    """Largest distance, in mm, between where the networks put a Gaussian and where they would in float64."""
    import torch

    with torch.no_grad():
        fast, exact = human()[0].means, copy.deepcopy(human).double()()[0].means
    return 1e3 * float((fast - exact).norm(dim=1).max())


def trained(folder: Path, settings: dict[str, Any], steps: int, seed: int) -> dict[str, Any]:
    """Held-out accuracy after a short training, and the median time of a step at full resolution, ms."""
    from stages import train
    from stages.avatar.measures.lpips import Lpips
    from stages.estimators.assets import fetch
    from stages.formats.clip import load_clip
    from stages.training.beginning.start import Task, build
    from stages.training.timing.accuracy import heldout_accuracy
    from tests.benchmarks.host import clock, summary
    from tests.benchmarks.workloads import surveyed

    clip = load_clip(folder / "sfm", folder / "smpl")
    decisions, starts = surveyed(folder)
    heldout = [i for i in np.flatnonzero(clip.heldout).tolist() if (clip.mask(i) > 127).any()]
    params = train.Params(steps=steps, **settings)
    fit = build(Task([clip], params, decisions, starts, seed), lambda text: None)
    times = []
    while fit.progress.step < steps:
        late = fit.progress.done >= fit.half_until
        took = clock(fit.advance)
        times += [took] if late else []
    with np.load(fetch("lpips_alex.npz")) as weights:
        accuracy = heldout_accuracy(fit.cast(), fit.seen(), heldout, Lpips(weights))
    return {"step": summary(times), "decode": decode_error(fit.people[0].human)} | accuracy


def measured(folder: Path, picture: Path, settings: dict[str, Any], steps: int, seed: int) -> dict[str, Any]:
    """Everything of one case, in the process that runs its code; the picture goes to a file."""
    import torch

    from stages.avatar import rasterize
    from tests.benchmarks.host import clock, summary
    from tests.benchmarks.workloads import learned_work

    work = learned_work(folder)
    means, quats, scales, opacities, colors = (part.requires_grad_() for part in work.parts)

    def draw() -> torch.Tensor:
        axes = rasterize.gaussian_axes(quats, scales)
        return rasterize.rasterize(rasterize.Gaussians(means, axes, opacities, colors), work.camera)[0].image

    np.save(picture, draw().detach().numpy())
    forward, backward = [], []
    for _ in range(30):
        forward.append(clock(draw))
        image = draw()
        backward.append(clock(lambda image=image: image.backward(work.v_image)))
    found = {"forward": summary(forward[5:]), "backward": summary(backward[5:])} | small_errors()
    return found | trained(folder, settings, steps, seed) if steps else found


def run(name: str, folder: Path, scratch: Path, steps: int, seed: int) -> dict[str, Any]:
    """One case in a process of its own, on a changed copy of the tree."""
    case, tree = CASES[name], scratch / name.replace("/", "_").replace(" ", "_")
    if not tree.exists():
        copy_tree(tree)
        for file, text, instead in case.edits:
            source = (tree / file).read_text()
            assert source.count(text) == 1, f"{text!r} stands {source.count(text)} times in {file}"
            (tree / file).write_text(source.replace(text, instead))
    picture, out = scratch / f"{tree.name}.npy", scratch / f"{tree.name}.json"
    asked = [str(folder.resolve()), str(picture), json.dumps(dict(case.settings)), str(steps), str(seed), str(out)]
    env = os.environ | {"PYTHONPATH": str(tree), "HUGS_CACHE": str(own_cache(scratch))}
    code = (
        "import json,sys; from pathlib import Path; from tests.benchmarks.approximations import measured; a = sys.argv; "
        "Path(a[6]).write_text(json.dumps(measured(Path(a[1]), Path(a[2]), json.loads(a[3]), int(a[4]), int(a[5]))))"
    )
    subprocess.run([sys.executable, "-c", code, *asked], cwd=tree, env=env, check=True)
    return {"name": name, "seed": seed, "picture": str(picture)} | json.loads(out.read_text())


def own_cache(scratch: Path) -> Path:
    """A cache for compiled kernels beside the user's, with the model files of that."""
    cache = scratch / "cache"
    if not cache.exists():
        cache.mkdir()
        home = Path(os.environ.get("HUGS_CACHE") or Path.home() / ".cache" / "hugs")
        for entry in home.iterdir():
            if entry.name != "kernels":
                (cache / entry.name).symlink_to(entry.resolve())
    return cache


def decibels(picture: str, like: str) -> float | None:
    """PSNR of two drawn pictures; None where they are the same."""
    error = float(np.mean((np.load(picture).astype(np.float64) - np.load(like)) ** 2))
    return -10 * np.log10(error) if error else None


def line(row: dict[str, Any]) -> str:
    """One row of the table."""
    forward, backward, drawn = row["forward"]["median"], row["backward"]["median"], row["drawn_db"]
    text = (
        f"{row['name']:24s} {row['seed']:4d} {forward:7.1f} {backward:7.1f} {row['small']:9.1e} {row['slopes']:9.1e} "
    )
    text += f"{drawn:7.1f}" if drawn else f"{'':7s}"
    if "step" in row:
        text += f" {row['step']['median']:8.1f} {row['decode']:7.3f}"
        text += f" {row['psnr']:6.2f} {row['psnr_person']:7.2f} {row['lpips_person']:7.4f}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", nargs="*", choices=CASES, metavar="NAME", default=list(CASES))
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    found: list[dict[str, Any]] = []
    print(f"{'':24s} seed  fwd ms  bwd ms     small    slopes   drawn  step ms  decode   full  person   LPIPS")
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(asked.seeds):  # the cases take turns, so that all see the same machine
            for name in ["exact", *(name for name in asked.only if name != "exact")]:
                row = run(name, asked.folder, Path(scratch), asked.steps, seed)
                found.append(row)
                drawn = decibels(row.pop("picture") if name != "exact" else row["picture"], found[0]["picture"])
                row["drawn_db"] = drawn
                print(line(row), flush=True)
                if asked.json:
                    asked.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

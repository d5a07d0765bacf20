"""What it costs and what it brings to draw and to compare in float32: a small training, taken three ways.

    python -m tests.benchmarks.precision [--steps 60] [--seeds 3]

The clip is that of tests/made/training.py (48x40 px, up to 560 Gaussians), small enough for the references in
float64: `stages/avatar/rasterize/reference.py` and `ssim_reference`. Each row is a mean over seeds; "off" is how far the
held-out picture of a row lies from that of the last one before anything was learned, "dB" its accuracy in the end.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from stages.avatar.measures.ssim import ssim_reference
from stages.avatar.rasterize import Camera, Gaussians, Layer, cpu, reference
from stages.training.step import losses
from stages.training.step.fit import Fit
from stages.training.step.person import Starting
from stages.training.timing.accuracy import heldout_accuracy
from tests.benchmarks.host import clock
from tests.made.training import make_clip, models, settings

TRAINED, HELD_OUT = [0, 1, 3, 4, 5], 2
WAYS = {"kernels, float32": None, "torch, float32": torch.float32, "torch, float64": torch.float64}


def drawn_in(dtype: torch.dtype) -> Callable[..., Any]:
    """The reference rasterizer in another number format, behind the kernel's signature."""

    def cast(value: Any) -> Any:
        return value.to(dtype) if isinstance(value, Tensor) and value.is_floating_point() else value

    def rasterize(gaussians: Gaussians, camera: Camera, layers: Sequence[Layer], near: float) -> Any:
        layers = [layer._replace(background=cast(layer.background)) for layer in layers]
        found = reference.rasterize(Gaussians(*map(cast, gaussians)), Camera(*map(cast, camera)), layers, near)
        return [replace(d, image=d.image.float(), alpha=d.alpha.float(), depth=d.depth.float()) for d in found]

    return rasterize


@contextmanager
def way(dtype: torch.dtype | None) -> Iterator[None]:
    """While it lasts, pictures are drawn and compared by the references in `dtype`; None: by the kernels."""
    if dtype is None:
        yield
        return
    compare = lambda image, target: ssim_reference(image.to(dtype), target.to(dtype)).float()  # noqa: E731
    with mock.patch.object(cpu, "rasterize", drawn_in(dtype)), mock.patch.object(losses, "ssim", compare):
        yield


def fit_of(clip: Any, steps: int, seed: int) -> Fit:
    """A training of the small clip that begins as `seed` says."""
    human, wall, generator = models(seed)
    return Fit(clip[0], TRAINED, [Starting(clip[1], human)], wall, *settings(steps), generator)


@torch.no_grad()
def picture(fit: Fit) -> Tensor:
    """The held-out frame as it is drawn now."""
    camera = Camera(fit.full.viewmats[HELD_OUT], fit.full.Ks[HELD_OUT], *fit.full.masks.shape[:0:-1])
    return fit.cast().at(HELD_OUT).draw(camera)[0].image


def trained(clip: Any, dtype: torch.dtype | None, steps: int, seed: int) -> tuple[Tensor, float, float]:
    """The first picture, the median time of a step at full size (ms), and the PSNR in the end (dB)."""
    with way(dtype):
        fit, times = fit_of(clip, steps, seed), []
        first = picture(fit)
        for _ in range(steps):
            full = fit.progress.done >= fit.half_until
            took = clock(fit.advance)
            times += [took] if full else []
        return first, statistics.median(times), heldout_accuracy(fit.cast(), fit.seen(), [HELD_OUT])["psnr"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=3)
    asked = parser.parse_args()
    clip = make_clip()
    found = {
        name: [trained(clip, dtype, asked.steps, seed) for seed in range(1, 1 + asked.seeds)]
        for name, dtype in WAYS.items()
    }
    *_, truth = found.values()
    print(f"{'':18s}      off  step ms     dB  of each seed")
    for name, runs in found.items():
        off = max(float((run[0] - true[0]).abs().max()) for run, true in zip(runs, truth))
        decibels = [run[2] for run in runs]
        each = " ".join(f"{one:.2f}" for one in decibels)
        print(
            f"{name:18s} {off:8.1e} {statistics.median(r[1] for r in runs):8.1f} {statistics.fmean(decibels):6.2f}  {each}"
        )


if __name__ == "__main__":
    main()

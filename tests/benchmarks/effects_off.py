"""What effects cost a clip that calls for none: the same training as it is, and with nothing where effects hook in.

    python -m tests.benchmarks.effects_off WORK [--steps 400]

The two take turns, step by step, on the clip without effects of `effect_models`, from one seed. Told are the medians of the
processor time of a step and their ratio, its spread over tenths of the run, and whether both ended in the same state to the
bit.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages import train
from stages.avatar.splats.compose import draw_together
from stages.formats.clip import load_clip
from stages.training.beginning.start import Task, build
from stages.training.step.fit import Fit
from tests.benchmarks.effect_models import ALWAYS, PARAMS, inputs

PARTS = 10


class Nothing(torch.nn.Module):
    """In place of `FrameEffects`: what a step would do if no effect had been written."""

    takes_time = blurs = False
    shadow = clothes = None

    def lit(self, person: Any) -> Any:
        return person

    def draw(self, sets: Any, motion: None, *view: Any) -> list:
        return draw_together([splats for splats, _ in sets], *view)

    def shade(self, scene: Any, bodies: Any) -> Any:
        return scene

    def shadow_depth(self, points: Tensor, bodies: Any) -> Tensor:
        return torch.zeros_like(points[:, 0])

    def prior(self) -> float:
        return 0.0


def bare(fit: Fit) -> Fit:
    """The training without the hooks of effects."""
    fit.effects, fit.speeds, fit._learn_effects = Nothing(), None, lambda: None
    return fit


def pair(work: Path, steps: int) -> tuple[Fit, Fit]:
    """Two trainings of one clip from one seed: as it is with all effects off, and bare."""
    place = work / "plain_seed0"
    task = Task([load_clip(*inputs(place))], train.Params(steps=steps, **PARAMS), ALWAYS)
    off, without = (build(task, print) for _ in range(2))
    return off, bare(without)


def measure(off: Fit, without: Fit, steps: int) -> np.ndarray:
    """Seconds of the processor [steps,2] of both, which go first in turns."""
    seconds = np.empty((steps, 2))
    for step in range(steps):
        for which in (0, 1) if step % 2 else (1, 0):
            began = time.process_time()
            (off, without)[which].advance()
            seconds[step, which] = time.process_time() - began
    return seconds


def alike(one: Fit, other: Fit) -> bool:
    """Whether all that was learned is the same to the last bit."""
    pairs = zip(*([part.state_dict() for part in fit.modules().values()] for fit in (one, other)))
    return all(a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a) for a, b in pairs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    args = parser.parse_args()
    off, without = pair(args.work, args.steps)
    seconds = measure(off, without, args.steps)
    medians = 1e3 * np.median(seconds, 0)
    parts = [np.median(part[:, 0]) / np.median(part[:, 1]) for part in np.array_split(seconds, PARTS)]
    print(f"all effects off {medians[0]:.2f} ms a step, without their hooks {medians[1]:.2f} ms")
    print(f"ratio {medians[0] / medians[1]:.4f}, of tenths of the run {min(parts):.3f} to {max(parts):.3f}, "
          f"standard error {np.std(parts, ddof=1) / PARTS**0.5:.4f}")  # fmt: skip
    print("the same to the bit" if alike(off, without) else "NOT the same to the bit")


if __name__ == "__main__":
    main()

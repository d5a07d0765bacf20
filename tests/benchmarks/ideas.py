"""What each idea in training is worth: the same training without it, or with the released code's way instead.

    python -m tests.benchmarks.ideas work/kitchen/default [--steps 1000] [--seeds 1] [--only NAME ...] [--json out.json]

The argument is the folder of a pipeline that has run; its frames, cameras, poses and decisions are used. Held-out frames
are rated with the person as training has it, before `bake` finishes it. Signed gradients ("absolute gradients") are those
of all layers of a step together, absolute ones those of the set's own layer.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from stages import train
from stages.avatar.effects import frames as frames_module
from stages.avatar.measures.lpips import Lpips
from stages.avatar.splats.compose import draw_together
from stages.estimators.assets import fetch
from stages.formats.clip import load_clip
from stages.training.beginning.start import Task, build
from stages.training.step import densify, losses, optimizers, schedule
from stages.training.step import fit as fit_module
from stages.training.timing.accuracy import heldout_accuracy
from tests.benchmarks import mcmc
from tests.benchmarks.workloads import surveyed


def put(owner, **values) -> list:
    """Patches of constants or functions."""
    return [mock.patch.object(owner, name, value) for name, value in values.items()]


def redrawn(change) -> list:
    """Drawings as densification sees them: `change(drawing, rows of the person)` in place of absolute gradients."""

    class Changed:
        def __init__(self, drawing, rows):
            self.drawing, self.rows = drawing, rows

        def __getattr__(self, name):
            return getattr(self.drawing, name)

        @property
        def screen_grad_abs(self):
            return change(self.drawing, self.rows)

    def draw(sets, *rest):
        rows = sum(len(person.means) for person in sets[:-1])
        return [Changed(drawing, rows) for drawing in draw_together(sets, *rest)]

    return put(frames_module, draw_together=draw)


def scene_by_others(drawing, rows):
    """The person's rows have their own gradients, those of the scene are shifted by them, as in the released code."""
    grad = drawing.screen_grad_abs
    return torch.cat([grad[:rows], grad.roll(rows, 0)[rows:]])


def by_area_of_the_person() -> list:
    """The difference of the whole picture counts as if averaged over the person's pixels, as the released code does."""
    area, outside, photometric = [1.0], losses.outside_person, losses.photometric

    def remember(image, target, mask):
        area[0] = mask.numel() / mask.sum().clamp(min=1.0)
        return outside(image, target, mask)

    def larger(image, target):
        by, area[0] = area[0], 1.0
        return photometric(image, target) + (by - 1) * (1 - losses.SSIM_SHARE) * (image - target).abs().mean()

    return put(losses, outside_person=remember, photometric=larger)


def of_one_metre(frames, people, scene, extent, *others):
    """The optimisers with rates of the scene's places that do not know its size."""
    return optimizers.optimizers(frames, people, scene, 1.0, *others)


UNSETTLED = put(schedule, SETTLE=0.9999, LAST_OTHERS=1.0) + put(
    densify,
    SETTLE=0.9999,
    SCENE_GROWTH=(schedule.SCENE_GROWTH[0], 1.0),
    HUMAN_GROWTH=(schedule.HUMAN_GROWTH[0], 1.0),
)
"""Growth to the end, rates that do not fall then; what the person hides keeps the colours it has, too."""


@dataclass(frozen=True)
class Idea:
    """How to train without it: settings of `train`, patches, decisions of `survey`."""

    settings: dict = field(default_factory=dict)
    patches: list = field(default_factory=list)
    decisions: dict = field(default_factory=dict)


STILL = {"place": 0.0, "pose": 0.0}
PLAIN = {"outside_person": lambda image, target, mask: target + (1 - mask)[..., None] * (image - target)}
WITHOUT = {
    "everything": Idea(),
    "own gradients for the scene (D1)": Idea(patches=redrawn(scene_by_others)),
    "an average over the picture (D8)": Idea(patches=by_area_of_the_person()),
    "rates by the scene's size": Idea(patches=put(fit_module, optimizers=of_one_metre)),
    "opacity shared by what comes of one": Idea(
        patches=put(densify, thinner=lambda opacities, rows: torch.zeros_like(opacities[rows.source]))
    ),
    "colours seen around, behind the person": Idea(
        patches=put(fit_module, inpaint_occluded=lambda scene, *_: torch.zeros(len(scene), dtype=torch.bool))
    ),
    "points where SfM saw nothing": Idea(settings={"scene_fill": 0}),
    "refined places (D3)": Idea(patches=put(optimizers, LR_FRAMES=schedule.LR_FRAMES | {"place": 0.0})),
    "refined poses and places": Idea(patches=put(optimizers, LR_FRAMES=schedule.LR_FRAMES | STILL)),
    "settling (D14)": Idea(patches=UNSETTLED),
    "absolute gradients": Idea(patches=redrawn(lambda d, rows: d.screen_grad)),
    "person pixels kept from the scene": Idea(patches=put(losses, outside_person=lambda image, target, mask: image)),
    "a seam around the person": Idea(patches=put(losses, **PLAIN)),
    "scene before the person kept away": Idea(patches=put(losses, OCCLUDERS=0.0)),
    "alpha from masks": Idea(patches=put(losses, ALPHA=0.0)),
    "own corrections beside the triplane's": Idea(patches=put(optimizers, LR_OWN=dict.fromkeys(schedule.LR_OWN, 0.0))),
    "shy corrections": Idea(patches=put(losses, REGULAR=0.0)),
    "a smooth surface": Idea(patches=put(losses, SMOOTH=0.0)),
    "a prior on skinning weights": Idea(patches=put(losses, LBS=0.0)),
    "faint and small Gaussians of the scene": Idea(patches=put(losses, FRUGAL=0.0)),
    "SSIM": Idea(patches=put(losses, SSIM_SHARE=0.0)),
    "but with LPIPS, AlexNet, every 4th step": Idea(settings={"perceptual_every": 4}),
    "but with 3rd degree colours of the scene": Idea(decisions={"view_dependence": True}),
    "but with refined cameras": Idea(decisions={"camera_refinement": True}),
    "but antialiased": Idea(decisions={"antialias": True}),
    "but the scene by MCMC": Idea(
        patches=put(densify, grow_scene=mcmc.relocate) + put(fit_module.Fit, _apply=mcmc.walking)
    ),
}


def ideas(folder: Path, names: list[str], steps: int, seeds: int) -> Iterator[dict]:
    """Train each variant with each seed, and rate it."""
    clip = load_clip(folder / "sfm", folder / "smpl")
    decisions, starts = surveyed(folder)
    heldout = [i for i in np.flatnonzero(clip.heldout).tolist() if (clip.mask(i) > 127).any()]
    with np.load(fetch("lpips_alex.npz")) as weights:
        lpips = Lpips(weights)
    for name in names:
        idea = WITHOUT[name]
        for seed in range(seeds):
            with ExitStack() as stack:
                for patch in idea.patches:
                    stack.enter_context(patch)
                params = train.Params(steps=steps, **idea.settings)
                fit = build(Task([clip], params, decisions | idea.decisions, starts, seed), lambda text: None)
                began = time.perf_counter()
                while fit.progress.step < steps:
                    fit.advance()
                seconds = time.perf_counter() - began
            yield (
                {"without": name, "seed": seed, "seconds": seconds}
                | fit.sizes()
                | heldout_accuracy(fit.cast(), fit.seen(), heldout, lpips)
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", nargs="*", choices=WITHOUT, metavar="NAME", default=list(WITHOUT))
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    found = []
    print(f"{'without':42s} seed  seconds   full  person   SSIM   LPIPS    scene")
    for row in ideas(asked.folder, asked.only, asked.steps, asked.seeds):
        found.append(row)
        person = f"{row['psnr_person']:7.2f} {row['ssim_person']:7.4f} {row['lpips_person']:7.4f}"
        numbers = f"{row['psnr']:7.2f} {person} {row['scene']:8,d}"
        print(f"{row['without']:42s} {row['seed']:4d} {row['seconds']:8.0f} {numbers}", flush=True)
        if asked.json:
            asked.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

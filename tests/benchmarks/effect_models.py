"""What each effect's model is worth: the same tiny clip without the effect, with it and ignored, with it and modelled.

    python -m tests.benchmarks.effect_models WORK [EFFECT ...] [--steps 500] [--seed 0] [--json out.json]

A clip is a NeuMan folder with true inputs (see tests/made/datasets.py), or with the noise that EFFECTS says. Frames that were
not trained on are drawn as their camera took them and compared: PSNR of the whole picture and of the person's box. Where
TRULY says so they are drawn sharp, from true cameras and with true poses, and compared with those of the clip without the
effect; where AFAR does, as from four times as far away, and in place of the clip without stands the same training drawn
large and averaged (Yu et al. 2024, trained at one size and seen at another). The seed is that of the clip and of the
training. A model pays if it brings back half of what the effect costs.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from stages import calibrated, masks, neuman, smpl, train
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.rasterize import Camera
from stages.contract import Job
from stages.estimators.detectors.every import DETECTORS
from stages.estimators.detectors.evidence import ClipEvidence
from stages.formats.clip import load_clip
from stages.formats.facts import Sfm, read_facts
from stages.training.beginning.start import Task, build
from stages.training.step.fit import Fit
from stages.training.step.refine import BodyCorrections, FrameCorrections
from stages.training.timing.accuracy import heldout_accuracy
from stages.training.views import Views
from tests.made import datasets
from tests.made.synthetic.effects import ClipEffects

SIZE = {"frames": 30, "width": 192, "height": 256, "points": 3000}
PARAMS = {"human_points": 7_000, "human_cap": 10_000, "scene_cap": 25_000, "scene_fill": 12_000}
ALWAYS = {"pose_refinement": False}  # true poses; what is decided unless an effect says otherwise
EFFECTS: dict[str, dict[str, Any]] = {
    "shadow": {"effects": ClipEffects(shadow=0.5)},
    "motion_blur": {"effects": ClipEffects(motion_blur=0.8)},
    "rolling_shutter": {"effects": ClipEffects(rolling_shutter=0.8)},
    "camera_refinement": {"camera_noise": 0.004},
    "pose_refinement": {"noise": 0.01},
    "exposure": {"effects": ClipEffects(exposure=0.08)},
    "view_dependence": {"effects": ClipEffects(view_dependence=0.5)},
    "transients": {"effects": ClipEffects(transients=4)},
    "antialias": {"effects": ClipEffects(antialias=3)},
    "sky": {"effects": ClipEffects(sky=1)},
    "clothing": {"effects": ClipEffects(clothing=0.06)},
    "shading": {"effects": ClipEffects(shading=1.2)},
}
"""Effect -> what `tests.made.datasets.neuman` makes of it; the name is also the decision that turns its model on."""
TRULY = ("motion_blur", "camera_refinement", "pose_refinement", "transients")
"""Blurred pictures are easier to meet than sharp ones; no model knows the errors of a frame it has not seen, nor who passes."""
AFAR = ("antialias",)
"""On the frames of the clip both are fitted to the sizes that they see, and another camera path shows another picture."""
TIMES = 4  # smaller

POSE = ("global_orient", "body_pose", "transl")


def inputs(place: Path, **made: Any) -> tuple[Path, Path]:
    """The folders of sfm and smpl of a clip, made unless they are there."""
    stages = {name: place / name for name in ("frames", "masks", "sfm", "smpl")}
    if not (stages["smpl"] / "body.npz").exists():
        clip = datasets.neuman(place, **SIZE, **made)
        for folder in stages.values():
            folder.mkdir(exist_ok=True)
        jobs = {name: Job(out=folder) for name, folder in stages.items()}
        neuman.run(jobs["frames"], neuman.Params(), video=clip.folder)
        masks.run(jobs["masks"], masks.Params(invert="never"), frames=stages["frames"], mask_files=None)
        calibrated.run(jobs["sfm"], calibrated.Params(), frames=stages["frames"], masks=stages["masks"])
        smpl.run(
            jobs["smpl"], smpl.Params(), frames=stages["frames"], sfm=stages["sfm"], smpl_fit=None, body_model=None
        )
    return stages["sfm"], stages["smpl"]


class Averaged(FrameEffects):
    """No effects; pictures are drawn TIMES as large and averaged, as a lens does."""

    def draw(self, sets, motion, camera, layers):
        K = camera.K * camera.K.new_tensor([TIMES, TIMES, 1.0])[:, None]
        large = Camera(camera.viewmat, K, TIMES * camera.width, TIMES * camera.height)
        drawn = super().draw(sets, motion, large, layers)
        return [replace(one, image=smaller(one.image)) for one in drawn]


def smaller(image: torch.Tensor) -> torch.Tensor:
    """A picture [H,W,C] at a TIMES-th of its size, by area."""
    return F.avg_pool2d(image.permute(2, 0, 1), TIMES).permute(1, 2, 0)


def trained(folders: tuple[Path, Path], args: argparse.Namespace, **decisions: bool) -> tuple[Fit, float]:
    """The training of a clip, and the seconds of processor that it took."""
    clip = load_clip(*folders)
    starts: dict[str, list[float]] = {}
    if decisions.get("shadow"):
        evidence = ClipEvidence(clip, read_facts(folders[0] / "sfm.json", Sfm))
        starts["shadow"] = DETECTORS["shadow"](evidence).start
    params = train.Params(steps=args.steps, **PARAMS)
    fit = build(Task([clip], params, ALWAYS | decisions, starts, args.seed), lambda text: None)
    began = time.process_time()
    while fit.progress.step < args.steps:
        fit.advance()
    return fit, time.process_time() - began


def rate(folders: tuple[Path, Path], args: argparse.Namespace, truth: Path | None, **decisions: bool) -> dict[str, Any]:
    """Train, and judge on all frames that were not trained on: as taken, or as the clip `truth` has them."""
    fit, seconds = trained(folders, args, **decisions)
    found = {name: p.detach().tolist() for name, p in fit.effects.named_parameters() if p.numel() < 4}
    if truth is not None:
        still = load_clip(truth / "sfm", truth / "smpl")
        images = torch.as_tensor(np.stack([still.images(i) for i in range(len(still.names))]))
        masks = torch.as_tensor(np.stack([still.mask(i) for i in range(len(still.names))]))
        viewmats = torch.as_tensor(still.viewmats).float()
        fit.full, fit.frames = Views(images, masks, viewmats, *fit.full[3:]), FrameCorrections(len(images))
        (who,) = fit.people
        who.corrections = BodyCorrections(len(images), who.body.own_bones)
        poses = {name: torch.as_tensor(getattr(still.body, name)).float() for name in POSE}
        who.body, fit.effects, fit.speeds = who.body._replace(**poses), FrameEffects(), None
    return heldout_accuracy(fit.cast(), fit.seen(), others(folders)) | {"cpu_seconds": seconds, "found": found}


def rate_afar(folders: tuple[Path, Path], args: argparse.Namespace, effect: str) -> dict[str, dict[str, Any]]:
    """Train without the model and with it, and judge from afar; 'without' is the first of them, drawn large and averaged."""
    rows = {}
    for arm, on in (("ignored", False), ("modelled", True)):
        fit, seconds = trained(folders, args, **{effect: on})
        for _ in range(TIMES.bit_length() - 1):
            fit.full = fit.full.half()
        rows[arm] = heldout_accuracy(fit.cast(), fit.seen(), others(folders)) | {"cpu_seconds": seconds, "found": {}}
        if not on:
            fit.effects = Averaged()
            rows["without"] = heldout_accuracy(fit.cast(), fit.seen(), others(folders)) | {"cpu_seconds": seconds}
    return rows


def others(folders: tuple[Path, Path]) -> list[int]:
    """Frames that are not trained on."""
    return np.flatnonzero(~load_clip(*folders).training).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("effects", nargs="*", metavar="EFFECT", help=f"of {', '.join(EFFECTS)}; all if none is named")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows, still, plain = {}, args.work / f"plain_seed{args.seed}", None
    for name in args.effects or EFFECTS:
        clip = inputs(args.work / f"{name}_seed{args.seed}", seed=args.seed, **EFFECTS[name])
        if name in AFAR:
            rows[name] = rate_afar(clip, args, name)
        else:
            sharp = inputs(still, seed=args.seed)
            plain = plain or rate(sharp, args, None)
            arms = {
                arm: rate(clip, args, still if name in TRULY else None, **{name: arm == "modelled"})
                for arm in ("ignored", "modelled")
            }
            rows[name] = {"without": plain} | arms
        for key in ("psnr", "psnr_person"):
            without, ignored, modelled = (rows[name][arm][key] for arm in ("without", "ignored", "modelled"))
            cost, gain = without - ignored, modelled - ignored
            numbers = f"without {without:.2f}  ignored {ignored:.2f}  modelled {modelled:.2f}"
            print(f"{name:<18} {key:<12} {numbers}   costs {cost:.2f} dB, the model brings back {gain:.2f}")
        seconds = ", ".join(f"{arm} {found['cpu_seconds']:.0f} s" for arm, found in rows[name].items())
        print(f"{name:<18} {seconds}; learned {rows[name]['modelled']['found']}", flush=True)
        if args.json:
            args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()

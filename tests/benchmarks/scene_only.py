"""What the person is worth: the finished joint model against a scene-only one of the same steps and Gaussians.

    python -m tests.benchmarks.scene_only work/kitchen/default [--json out.json]

The argument is the folder of a pipeline that has run. The scene-only model is the same scene of the same code, but it
learns every pixel, the person's too, without effects, and may have as many Gaussians as person and scene had together.
Both are rated on the same held-out frames; `evaluate` rated the joint one, with poses untouched.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from stages import train
from stages.avatar.measures.metrics import person_crop, scores
from stages.avatar.rasterize import Camera
from stages.avatar.splats.compose import draw_together
from stages.formats.clip import load_clip
from stages.training.beginning.start import Task, build
from stages.training.step.fit import Fit
from tests.benchmarks.workloads import surveyed


def scene_only(folder: Path) -> dict:
    """Train the scene-only model and rate it; the joint model's figures come from the folder."""
    clip = load_clip(folder / "sfm", folder / "smpl")
    joint = json.loads((folder / "evaluate" / "metrics.json").read_text())
    known = json.loads((folder / "train" / "train.json").read_text())
    decisions, starts = surveyed(folder)
    params = train.Params(steps=known["steps"])
    both = build(Task([clip], params, decisions | {"scene": True}, starts), print)
    params = both.params.model_copy(update={"scene_cap": sum(known["gaussians"].values())})
    options = both.options._replace(exposure=False)
    everything = both.full._replace(masks=torch.zeros_like(both.full.masks))
    fit = Fit(everything, both.train, [], both.scene, params, options, torch.Generator().manual_seed(0))
    began = time.perf_counter()
    while fit.progress.step < params.steps:
        fit.advance()
        if fit.progress.step % 500 == 0:
            print(f"  step {fit.progress.step} of {params.steps}, {len(fit.scene):,} Gaussians", flush=True)
    seconds = time.perf_counter() - began
    sums = {"full": {"psnr": [], "ssim": []}, "person_crop": {"psnr": [], "ssim": []}}
    with torch.no_grad():
        splats, views, cameras = fit.scene.splats(), both.full, fit.cameras()
        for i in (i for i in range(len(clip.names)) if clip.heldout[i]):
            image, mask = views.images[i].float() / 255, views.masks[i].float() / 255
            camera = Camera(cameras[i], views.Ks[i], *reversed(mask.shape))
            drawn = draw_together([splats], camera)[0].image.clamp(0, 1)
            for name, crop in (("full", ...), ("person_crop", person_crop(mask))):
                if crop is not None:
                    score = scores(drawn[crop].contiguous(), image[crop].contiguous())
                    for key, values in sums[name].items():
                        values.append(score[key])
    rated = {name: {key: sum(v) / len(v) for key, v in part.items()} for name, part in sums.items()}
    return {
        "steps": params.steps,
        "joint": {name: {key: joint["heldout"][name][key] for key in rated[name]} for name in rated},
        "joint_gaussians": known["gaussians"],
        "scene_only": rated,
        "scene_only_gaussians": len(fit.scene),
        "scene_only_seconds": round(seconds, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    result = scene_only(asked.folder)
    print(f"{'held out':12s} {'joint':>18s} {'scene only':>18s}")
    for name, rated in result["scene_only"].items():
        cells = [f"{part['psnr']:6.2f} dB {part['ssim']:.3f}" for part in (result["joint"][name], rated)]
        print(f"{name:12s} {cells[0]:>18s} {cells[1]:>18s}")
    if asked.json:
        asked.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()

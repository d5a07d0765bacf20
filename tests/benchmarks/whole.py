"""What `hugs run` makes of clips that are hard all at once, compared with their truth.

    python -m tests.benchmarks.whole WORK [--half setting] [--only skirt coat] [--json out.json]

Somebody in a skirt and with a ponytail, or in a long coat and with a bag, 60 frames of 384x512, through a lens that bends, with an
open shutter, while exposure and white balance drift. The video alone goes in, through pipeline `default`. Seed 4 is for
setting, seed 5 is asked. Printed: how far cameras and joints are off, how well masks overlap, PSNR and LPIPS in the
person's box of held-out frames, and of six new poses from new cameras, in which clothes are at rest. A picture beside
the results shows the latter below the truth.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stages.avatar.measures.lpips import Lpips
from stages.estimators.assets import fetch
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.clip import load_clip
from stages.formats.effects import read_effects
from stages.formats.images import write_image
from stages.formats.poses import read_poses
from stages.formats.splats import read_avatar, read_scene
from stages.synthetic.files import write_clip
from tests.benchmarks.loose import Shown, novel
from tests.made.command import hugs
from tests.made.learned import load_learned
from tests.made.synthetic.clip import make_clip
from tests.made.synthetic.effects import ClipEffects
from tests.made.truth import align, camera_errors, joint_errors, mask_ious

WEARS = {"skirt": ("skirt", "ponytail"), "coat": ("coat", "bag")}
SEEDS = {"setting": 4, "asked": 5}
EFFECTS = ClipEffects(exposure=0.05, white_balance=0.05, lens=-0.05, motion_blur=0.3)


def made(folder: Path, name: str, seed: int) -> Path:
    """The folder of a clip and its truth; made once, which takes minutes."""
    if not (folder / "clip.mp4").exists():
        write_clip(folder, make_clip(read_body_model(), seed=seed, wears=WEARS[name], effects=EFFECTS))
    return folder


def rate(folder: Path, lpips: Lpips) -> dict[str, Any]:
    """Run the pipeline on the clip in `folder`, and compare its results with the truth there."""
    began = time.perf_counter()
    hugs("run", folder / "clip.mp4", "--work", folder / "work", seconds=7200)
    seconds, results, truth = time.perf_counter() - began, folder / "work" / "clip" / "default", folder / "truth"
    cameras, known = read_cameras(results / "sfm" / "cameras.npz"), read_cameras(truth / "cameras.npz")
    body, poses = read_poses(results / "train" / "body.npz"), read_poses(truth / "body.npz")
    model, similarity = read_body_model(results / "smpl" / "body_model.npz"), align(cameras, known, body.world_from_sfm)
    world, about = joint_errors(body, poses, similarity, model, read_body_model())
    held = json.loads((results / "evaluate" / "metrics.json").read_bytes())["heldout"]["person_crop"]
    splats = read_avatar(results / "train" / "avatar.npz"), read_scene(results / "train" / "scene.npz")
    learned = load_learned(*splats, read_effects(results / "train" / "effects.npz"))
    new, picture = novel(folder / "work", Shown(load_clip(results / "sfm", results / "smpl"), body, learned, lpips))
    write_image(folder / "novel.png", picture)
    return {
        "seconds": seconds,
        "cameras_mm": 1000 * camera_errors(cameras, known, len(known.names)).centre,
        "masks_iou": float(mask_ious(results / "sfm" / "masks", truth / "masks").mean()),
        "joints_cm": [100 * world, 100 * about],
        "heldout": {key: held[key] for key in ("psnr", "lpips")},
        "novel": new,
    }


def told(name: str, row: dict[str, Any]) -> str:
    """What `rate` found of a clip, as lines."""
    world, about = row["joints_cm"]
    scored = {key: f"{row[key]['psnr']:.2f} dB, LPIPS {row[key]['lpips']:.3f}" for key in ("heldout", "novel")}
    return (
        f"{name}: {row['seconds'] / 60:.0f} min, cameras {row['cameras_mm']:.1f} mm off, masks {row['masks_iou']:.3f}\n"
        f"    joints {world:.1f} cm off, {about:.1f} about the pelvis\n"
        f"    held-out frames {scored['heldout']}, new poses {scored['novel']}"
    )


def rate_each(clips: Mapping[str, Callable[[], Path]], json_file: Path | None) -> None:
    """Rate the clips whose folders these make, print what is found of each, and write it into a file if one is named."""
    rows = {}
    with np.load(fetch("lpips_alex.npz")) as arrays:
        lpips = Lpips(arrays)
    for name, folder in clips.items():
        rows[name] = rate(folder(), lpips)
        print(told(name, rows[name]), flush=True)
        if json_file:
            json_file.write_text(json.dumps(rows, indent=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--half", choices=SEEDS, default="setting")
    parser.add_argument("--only", nargs="+", choices=WEARS, default=list(WEARS))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    seed = SEEDS[args.half]
    rate_each({name: partial(made, args.work / f"{name}{seed}", name, seed) for name in args.only}, args.json)


if __name__ == "__main__":
    main()

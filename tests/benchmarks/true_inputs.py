"""What training alone is worth: the synthetic clip with its true cameras, masks and poses, as a NeuMan folder.

    python -m tests.benchmarks.true_inputs WORK [--noise 0.01] [--json out.json] [hugs run options]

The pictures are those of the video that `hugs demo` makes, with what its coding left of them, so that the inputs are
all that differs from a run on that video. `--noise` adds errors of that standard deviation to the poses (see
tests/made/datasets.py), which refinement has to find.
Other options go to `hugs run`: `--set train.steps=1000 --seed 1`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from stages.synthetic.files import CRF
from tests.made import datasets
from tests.made.truth import novel_psnr, tell_novel_poses

HUGS = [sys.executable, "-c", "from hugs_cli import main; main()"]
SIZE = {"frames": 60, "width": 384, "height": 512, "points": 4000}  # as `hugs demo` has it


def true_inputs(work: Path, noise: float, more: list[str]) -> dict:
    """Run the pipeline and rate held-out frames and novel poses."""
    place = work / f"noise{noise:g}"
    made = datasets.Made(place / "bike", place / "truth")
    if not made.folder.exists():
        datasets.neuman(place, noise=noise, crf=CRF, **SIZE)
    options = ["--pipeline", "neuman", "--work", str(work / f"work{noise:g}")]
    subprocess.run([*HUGS, "run", str(made.folder), *options, *more], check=True)
    results, out = work / f"work{noise:g}" / "bike" / "neuman", place / "told"
    out.mkdir(exist_ok=True)
    names = tell_novel_poses(results, made.truth, out)
    told = ["--cameras", str(out / "cameras.npz"), "--poses", str(out / "poses.npz"), "--out", str(out / "pictures")]
    subprocess.run([*HUGS, "render", str(made.folder), *told, *options], check=True)
    full, crop = novel_psnr(out / "pictures", made.truth, names)
    heldout = json.loads((results / "evaluate" / "metrics.json").read_bytes())["heldout"]
    return {"noise": noise, "options": more, "heldout": heldout, "novel": {"full": full, "person_crop": crop}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--json", type=Path)
    args, more = parser.parse_known_args()
    found = true_inputs(args.work, args.noise, more)
    for region in ("full", "person_crop"):
        row = found["heldout"][region]
        numbers = f"PSNR {row['psnr']:.2f}  SSIM {row['ssim']:.3f}  LPIPS {row['lpips']:.3f}"
        print(f"{region:<12} held out {numbers}   novel poses {found['novel'][region]:.2f} dB")
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()

"""How well a back is guessed that no frame shows: trained on the frames that see a front, asked in those from behind.

    python -m tests.benchmarks.backs work/clip/default [RESULTS ...] [--json out.json]

For clips that see somebody from all around. Who has turned away from the camera by less than FRONT is trained on, by more than
BACK asked; nothing between. PSNR and LPIPS in the person's box, as trained and finished. Body fit and masks come from all frames.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages import train
from stages.avatar.measures.lpips import Lpips
from stages.estimators.assets import fetch
from stages.formats.clip import Clip, load_clip
from stages.formats.splits import write_split
from stages.records import Effects
from stages.training.beginning.start import Task, build
from stages.training.timing.accuracy import heldout_accuracy
from tests.benchmarks.host import tell
from tests.benchmarks.loose import Shown, finished, of_one
from tests.benchmarks.workloads import surveyed
from tests.made.learned import load_learned

FRONT, BACK = 60.0, 110.0  # degrees


def turned_away(clip: Clip) -> np.ndarray:
    """By how many degrees [F], 0 to 180, the person is turned away from the camera, seen from above."""
    turns = Rotation.from_rotvec(clip.body.global_orient).as_matrix()
    up = turns[:, :, 1].mean(0) / np.linalg.norm(turns[:, :, 1].mean(0))
    eyes = -np.einsum("fji,fj->fi", clip.viewmats[:, :3, :3], clip.viewmats[:, :3, 3])
    ways = [way - (way @ up)[:, None] * up for way in (turns[:, :, 2], eyes - clip.body.transl)]
    cosines = np.prod([ways[0], ways[1]], 0).sum(1) / np.prod([np.linalg.norm(way, axis=1) for way in ways], 0)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def measure(results: Path, lpips: Lpips) -> dict[str, Any]:
    """Scores from behind of a training on the front alone."""
    away = turned_away(load_clip(results / "sfm", results / "smpl"))
    with tempfile.TemporaryDirectory() as folder:
        for path in (results / "sfm").iterdir():
            Path(folder, path.name).symlink_to(path.resolve())
        names = load_clip(results / "sfm", results / "smpl").names
        kinds = np.where(away < FRONT, "train", np.where(away > BACK, "heldout", "unused"))
        Path(folder, "split.json").unlink(missing_ok=True)
        write_split(
            Path(folder, "split.json"), "fronts", {n: (k, i) for i, (n, k) in enumerate(zip(names, kinds.tolist()))}
        )
        clip, params = load_clip(Path(folder), results / "smpl"), train.Params()
        fit = build(Task([clip], params, *surveyed(results)), lambda text: None)
        while fit.progress.step < params.steps:
            fit.advance()
        others = [i for i in np.flatnonzero(clip.heldout).tolist() if clip.shows_person(i)]
        before = heldout_accuracy(fit.cast(), fit.seen(), others, lpips)
        result, avatar, body = of_one(fit, clip)
        shown = Shown(clip, body, load_learned(avatar, result.scene, result.effects or Effects()), lpips)
        after = finished(shown, fit, others)
    trained = {name: before[f"{name}_person"] for name in ("psnr", "lpips")}
    return {"fronts": int(clip.training.sum()), "backs": len(others), "as trained": trained, "finished": after}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    with np.load(fetch("lpips_alex.npz")) as arrays:
        lpips = Lpips(arrays)
    tell({str(folder): measure(folder, lpips) for folder in asked.results}, asked.json)


if __name__ == "__main__":
    main()

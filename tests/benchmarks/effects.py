"""Does the survey see each effect where it is, and only there? Pairs of synthetic clips, with the effect and without.

    python -m tests.benchmarks.effects WORK [--seeds 10 11] [--only shadow sky] [--strength 2] [--json out.json]

Each clip goes through the stages of pipeline `neuman` up to `survey`, with true inputs. Thresholds were set on seeds 0 and 1
with all strengths (`--seeds 0 1 --strength 1 2 3`); other seeds judge them. A clip without effects serves all effects.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from stages import calibrated, masks, neuman, smpl, survey
from stages.contract import Job
from stages.estimators.detectors.every import DETECTORS
from stages.estimators.detectors.evidence import ClipEvidence
from stages.formats.clip import load_clip
from stages.formats.facts import Sfm, read_facts
from tests.made import datasets
from tests.made.synthetic.effects import ClipEffects

SIZE = {"frames": 30, "width": 240, "height": 320, "points": 2000}
STRENGTHS = {
    "view_dependence": (0.15, 0.3, 0.5),
    "exposure": (0.04, 0.08, 0.15),
    "lens": (-0.02, -0.05, -0.1),
    "rolling_shutter": (0.3, 0.5, 0.8),
    "motion_blur": (0.4, 0.6, 0.9),
    "shadow": (0.3, 0.5, 0.7),
    "shading": (0.8, 1.2, 1.6),
    "clothing": (0.05, 0.08, 0.12),
    "pose_refinement": (0.02, 0.04, 0.08),
    "camera_refinement": (0.003, 0.006, 0.01),
    "sky": (1.0, 1.0, 1.0),
    "transients": (1, 2, 3),
    "antialias": (1.8, 2.2, 2.6),
}
"""Of each effect, as tests.made.synthetic.effects means it; of the refinements the noise of tests.made.datasets.neuman."""
GIVEN = {"pose_refinement": "noise", "camera_refinement": "camera_noise"}


def clip(work: Path, seed: int, effect: str | None = None, level: int = 2) -> Path:
    """The folder with what the stages before `survey` make of the clip; made once."""
    strength = STRENGTHS[effect][level - 1] if effect else 0.0
    place = work / (f"{effect}_{strength:g}_seed{seed}" if effect else f"none_seed{seed}")
    if (place / "smpl" / "done").exists():
        return place
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    if effect in GIVEN:
        made = datasets.neuman(place, seed=seed, **{GIVEN[effect]: strength}, **SIZE)
    else:
        made = datasets.neuman(place, seed=seed, effects=ClipEffects(**({effect: strength} if effect else {})), **SIZE)
    for stage in ("frames", "masks", "sfm", "smpl"):
        (place / stage).mkdir()
    frames, sfm = place / "frames", place / "sfm"
    neuman.run(Job(frames), neuman.Params(), video=made.folder)
    masks.run(Job(place / "masks"), masks.Params(invert="never"), frames=frames)
    calibrated.run(Job(sfm), calibrated.Params(), frames=frames, masks=place / "masks")
    smpl.run(Job(place / "smpl"), smpl.Params(), frames=frames, sfm=sfm)
    (place / "smpl" / "done").touch()
    return place


def measured(place: Path, effects: list[str]) -> dict[str, dict]:
    """What `survey` writes of these effects for a clip's folder."""
    facts = read_facts(place / "sfm" / "sfm.json", Sfm)
    evidence = ClipEvidence(load_clip(place / "sfm", place / "smpl"), facts)
    return {name: survey.decide("auto", DETECTORS[name](evidence)) for name in effects}


def judge(work: Path, seeds: list[int], effects: list[str], levels: list[int]) -> list[dict]:
    """A row for each effect, seed and clip: what was measured, and whether the verdict is right."""
    rows = []
    for seed in seeds:
        clean = measured(clip(work, seed), effects)
        for effect in effects:
            tries = [("without", clean[effect])]
            tries += [
                (f"{STRENGTHS[effect][n - 1]:g}", measured(clip(work, seed, effect, n), [effect])[effect])
                for n in levels
            ]
            for strength, found in tries:
                row = found | {"effect": effect, "seed": seed, "strength": strength}
                rows.append(row | {"right": row["on"] == (strength != "without")})
                tell(rows[-1])
    return rows


def tell(row: dict) -> None:
    """One line of the table."""
    value = "nothing" if row["value"] is None else f"{row['value']:.3g}"
    right = "" if row["right"] else "WRONG"
    print(
        f"{row['effect']:<18}seed {row['seed']:<4}{row['strength']:<9}{value:>9} {row['unit']:<48}limit {row['threshold']:<7g}"
        f"{row['verdict']:<28}confidence {row['confidence']:.2f}  {right}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11])
    parser.add_argument("--only", nargs="+", choices=STRENGTHS, default=list(STRENGTHS))
    parser.add_argument("--strength", type=int, nargs="+", choices=(1, 2, 3), default=[2])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = judge(args.work, args.seeds, args.only, args.strength)
    wrong = sum(not row["right"] for row in rows)
    print(f"{wrong} of {len(rows)} verdicts wrong")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()

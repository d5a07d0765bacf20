"""How good the body fit is on a family of synthetic clips that nobody tuned to one of, on courtyard and on treadmill.

    python -m tests.benchmarks.fit build/family --half setting [--clips turn_level lie_high] [--jobs 2]
    python -m tests.benchmarks.fit build/family --clips none --courtyard work/courtyard/default --treadmill

The folder keeps the clips and what the fit is given of them: pictures, our masks, landmarks, and the true cameras with
errors as SfM makes them, in its units. What is missing is made; HUGS_CLIPS names the folder of real clips, whose captured
motions some clips use. `--half setting` is for setting constants, `--half asked` once per change of code. A line for each
clip, then median, 90th percentile and worst of each column; what the columns mean is printed below.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from stages.estimators.bodyfit.metre import BY_BODY, BY_HEIGHT
from stages.estimators.bodyfit.quality import measure_quality
from stages.formats.body_model import read_body_model
from tests.made.family.courtyard import measure_finished
from tests.made.family.doubt import errors_of, in_bins
from tests.made.family.evidence import fit_take, make_take, read_take
from tests.made.family.measures import COLUMNS, measured
from tests.made.family.table import Shot, shots
from tests.made.family.treadmill import measure_treadmill

Row = dict[str, float]


def prepare(shot: Shot, folder: Path, clips: Path | None) -> None:
    """Make the clip if it is not in the folder."""
    if not is_made(shot, folder):
        make_take(folder / shot.name, shot, clips / "motion" if clips else None)


def is_made(shot: Shot, folder: Path) -> bool:
    """Whether all of the clip is in the folder."""
    return all((folder / shot.name / part).exists() for part in ("truth/world.npz", "facts.json"))


def rate(shot: Shot, folder: Path) -> tuple[str, Row, np.ndarray, np.ndarray]:
    """Fit the body of a clip, and measure it; also the processor's seconds that the fit took, and how far each joint is
    expected to be off and is, [F,24,2] m."""
    take, truth = read_take(folder / shot.name)
    begun = time.process_time()
    fit, evidence = fit_take(take)
    seconds, model = time.process_time() - begun, read_body_model()
    quality = measure_quality(fit.poses, model, take.cameras, take.times, take.masks, evidence, fit.pixels)
    about = (replace(fit.poses, confidence=quality.confidence), model, take.cameras, take.moving, truth)
    return shot.name, {**measured(*about, take.masks), "s": seconds}, fit.expected_error, errors_of(*about)


def show(name: str, values: Sequence[float]) -> None:
    """Print one line of the table."""
    print(f"{name:<18}", *(f"{value:8.2f}" for value in values), flush=True)


def summarize(rows: dict[str, Row]) -> None:
    """Print median, 90th percentile and worst of each column, of its size where it has a sign; IoU from the other end."""
    table = np.array([list(row.values()) for row in rows.values()])
    better = np.array([name == "IoU" for name in next(iter(rows.values()))])
    size = np.where(better, -table, abs(table))
    for name, share in (("median", 50), ("90th percentile", 90), ("worst", 100)):
        show(name, abs(np.nanpercentile(size, share, axis=0)))
    show("mean with sign", np.nanmean(table, axis=0))


def show_doubts(expected: Sequence[np.ndarray], found: Sequence[np.ndarray]) -> None:
    """Print what is expected beside what is measured, for joints from the surest to the least sure."""
    for name, bins in zip(("along", "across"), in_bins(expected, found), strict=True):
        pairs = ", ".join(f"{a:.1f}: {b:.1f}" for a, b in bins)
        kept = np.mean(abs(np.log2(bins[:, 1] / bins[:, 0])) < 1)
        print(f"expected: measured {name} the view, cm: {pairs}; within a factor of two in {kept:.0%}")


def show_metre(rows: Sequence[Row]) -> None:
    """Print how far a metre is off where the height is given, and how often people are as tall as they look."""
    size, metre = (1 + np.array([row[name] for row in rows]) / 100 for name in ("tall%", "scale%"))
    off, looks = 100 * abs(1 / size - 1), np.exp(abs(np.log(size * metre))) - 1
    print(
        f"metre by a given height: {np.median(off):.1f} % off at the median, {off.max():.1f} at the worst,"
        f" to {100 * BY_HEIGHT:.0f} % in {(off < 100 * BY_HEIGHT).sum()} of {len(off)};"
        f" by the body: to {100 * BY_BODY:.0f} % in {(looks < BY_BODY).sum()}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--clips", nargs="+", default=[], help="names of the table; none: no clip of the family")
    parser.add_argument("--half", choices=("setting", "asked"))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--courtyard", type=Path, help="the results of a finished run on it: WORK/courtyard/default")
    parser.add_argument("--treadmill", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    named = os.environ.get("HUGS_CLIPS")
    clips = Path(named) if named else None
    wanted = [] if args.clips == ["none"] else shots(args.half, tuple(args.clips))
    if clips is None and (args.courtyard or args.treadmill):
        parser.error("HUGS_CLIPS must name the folder of real clips for --courtyard and --treadmill")
    if clips is None:
        missing = [shot for shot in wanted if "." in shot.motion and not is_made(shot, args.folder)]
        for shot in missing:
            print(f"{shot.name} is left out: HUGS_CLIPS names no folder with motion/{shot.motion}")
        wanted = [shot for shot in wanted if shot not in missing]
    rows: dict[str, Row] = {}
    doubts: list[tuple[np.ndarray, np.ndarray]] = []
    with ProcessPoolExecutor(args.jobs) as pool:
        list(pool.map(partial(prepare, folder=args.folder, clips=clips), wanted))
        print(f"{'':<18}", *(f"{name:>8}" for name in (*COLUMNS, "s")))
        for name, row, expected, found in pool.map(partial(rate, folder=args.folder), wanted):
            rows[name] = row
            doubts.append((expected, found))
            show(name, list(row.values()))
    if rows:
        summarize(rows)
        show_doubts(*zip(*doubts, strict=True))
        show_metre(list(rows.values()))
    if args.courtyard:
        finished = measure_finished(clips / "courtyard", args.courtyard)
        for name, row in finished.items():
            show(name, list(row.values()))
        rows |= finished
    if args.treadmill:
        rows["treadmill"] = measure_treadmill(args.folder / "treadmill", clips / "treadmill")
        print("treadmill, cm:", ", ".join(f"{key} {value:.1f}" for key, value in rows["treadmill"].items()))
    print("\n" + "\n".join(f"{name:<8} {what}" for name, what in COLUMNS.items()))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""Comparing trainings of one clip: the common part of `hugs ablate` and `hugs costs`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, stdev
from types import MappingProxyType
from typing import Any

from hugs_cli import pipelines, times
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.workspace import Workspace
from hugs_cli.pipelines import UsageError

LAST = "evaluate"
SEEDED = ("train", LAST)  # all seeds share the stages before
REGIONS = {"full": "whole picture", "person_crop": "person", "person_white": "person over white"}
METRICS = {"psnr": 2, "ssim": 4, "lpips": 4}  # with the decimals that are shown
PAPERS = {"psnr_per_channel": 2, "ssim": 4, "lpips_legacy": 4}
"""As the paper's code computes PSNR, SSIM and LPIPS, with the decimals that are shown."""

Scores = dict[str, dict[str, float | None]]
"""Region -> metric -> value on frames never trained on; None where nothing was measured."""


@dataclass(frozen=True)
class Case:
    """One training: which variant of the pipeline ('' for the pipeline itself), with which seed."""

    variant: str
    seed: int
    session: Session

    @property
    def stages(self) -> list[str]:
        """The stages that must be fresh, in running order."""
        return self.session.pipeline.upstream([LAST])


def cases(session: Session, variants: Sequence[str], seeds: int) -> list[Case]:
    """A case for each variant and seed, seed by seed; UsageError for a pipeline that is a variant already.

    The first seed's results stand under the pipeline's own names (`default`, `default.no_lbs`), those of another seed
    under `default.seed1`, `default.no_lbs.seed1`.
    """
    if "." in session.pipeline.name:
        whole = session.pipeline.name.partition(".")[0]
        raise UsageError(f"{session.pipeline.name} is a variant already", f"compare with `--pipeline {whole}`")
    session.pipeline.upstream(["train", LAST])  # refuses a pipeline without them
    found = []
    for seed in range(session.seed, session.seed + seeds):
        for name in variants:
            pipeline = pipelines.variant(session.pipeline, name) if name else session.pipeline
            links = pipeline.name if seed == session.seed else f"{pipeline.name}.seed{seed}"
            place = Workspace(session.video, session.workspace.work, links)
            own = dict.fromkeys(SEEDED, seed)
            found.append(Case(name, seed, replace(session, workspace=place, pipeline=pipeline, seeds=own)))
    return found


def expected(
    cases: Sequence[Case], device: str, levels: Mapping[str, tuple[str, float]] = MappingProxyType({})
) -> list[tuple[str, times.Guess]]:
    """The stages that all cases together will run, in order, on 'cpu' or 'cuda'; what cases share is run once.

    `levels`: variant -> the stage in which it differs, if not in training, and its time relative to the pipeline's.
    """
    known, counted, found = times.here(device), set[str](), []
    for case in cases:
        pipeline, (differs, factor) = case.session.pipeline, levels.get(case.variant, ("train", 1.0))
        missing = [name for name, verdict in case.session.verdicts(case.stages).items() if not verdict.fresh]
        for name, guess in known.forecast(case.session, missing, first=not counted).items():
            if name in SEEDED or name not in counted or (case.variant and differs in pipeline.upstream([name])):
                found.append((name, guess._replace(seconds=guess.seconds * (factor if name == differs else 1.0))))
            counted.add(name)
    return found


def heldout(folder: Path) -> Scores:
    """What an `evaluate` result measured on frames never trained on."""
    return json.loads((folder / "metrics.json").read_bytes())["heldout"]


def over_seeds(values: Iterable[float | None]) -> dict[str, Any]:
    """The `values` of all seeds, their `mean` and `spread` (standard deviation); None where a seed has no value, or
    there is one seed."""
    values = list(values)
    known = [value for value in values if value is not None]
    mean = fmean(known) if len(known) == len(values) else None
    spread = stdev(known) if mean is not None and len(known) > 1 else None
    return {"mean": mean, "spread": spread, "values": values}


def measured(tables: Sequence[dict[str, Any]]) -> list[str]:
    """The regions in which all tables (region -> metric -> `over_seeds`) have a value; the person over white only where
    there is no other."""
    known = [region for region in REGIONS if all(one[region]["psnr"]["mean"] is not None for one in tables)]
    return [region for region in known if region != "person_white"] or known


def cell(numbers: dict[str, Any], digits: int) -> str:
    """'28.91 ±0.12  -0.34': mean, spread, difference, '~' behind one within the noise; '-' where nothing was measured."""
    if numbers["mean"] is None:
        return "-"
    spread = "" if numbers["spread"] is None else f" ±{numbers['spread']:.{digits}f}"
    difference = numbers.get("difference")
    said = "" if difference is None else f"  {difference:+.{digits}f}{'~' * bool(numbers.get('within_noise'))}"
    return f"{numbers['mean']:.{digits}f}{spread}{said}"

"""The paper's ablations on one clip: a pipeline and its variants, over seeds, and the table of what each part is worth."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from statistics import fmean, stdev
from typing import Any

from hugs_cli import engine, pipelines
from hugs_cli.console import Console
from hugs_cli.freshness import Judge
from hugs_cli.pipelines import ABLATIONS, UsageError
from hugs_cli.words import count, duration
from hugs_cli.workspace import Stamp, Workspace

LAST = "evaluate"
SEEDED = ("train", LAST)  # every seed shares what lies before
REGIONS = {"full": "whole picture", "person_crop": "person", "person_white": "person over white"}
METRICS = {"psnr": 2, "ssim": 4, "lpips": 4}  # with the decimals that are shown
NEEDS_SCENE = ("no_human_loss", "no_joint")


@dataclass(frozen=True)
class Case:
    """One training: without which part (a name of ABLATIONS, or '' for the full method), with which seed."""

    part: str
    seed: int
    judge: Judge

    @property
    def stages(self) -> list[str]:
        """What must be fresh, in running order."""
        return self.judge.pipeline.upstream([LAST])


def cases(judge: Judge, seeds: int) -> list[Case]:
    """Every training of a comparison, seed by seed, the full method first.

    The first seed's results stand under the pipeline's own names (`default`, `default.no_lbs`), those of another seed
    under `default.seed1`, `default.no_lbs.seed1`.
    """
    if "." in judge.pipeline.name:
        whole = judge.pipeline.name.partition(".")[0]
        raise UsageError(f"{judge.pipeline.name} lacks a part already", f"compare with `--pipeline {whole}`")
    found = []
    for seed in range(judge.seed, judge.seed + seeds):
        for part in ("", *ABLATIONS):
            pipeline = pipelines.variant(judge.pipeline, part) if part else judge.pipeline
            links = pipeline.name if seed == judge.seed else f"{pipeline.name}.seed{seed}"
            place = Workspace(judge.sources["video"], judge.workspace.work, links)
            own = dict.fromkeys(SEEDED, seed)
            found.append(Case(part, seed, replace(judge, workspace=place, pipeline=pipeline, seeds=own)))
    return found


def plan(cases: list[Case]) -> list[tuple[Case, str, Stamp | None]]:
    """Each case, the state of its training (fresh, missing, stale, waits), and the stamp of a fresh one."""
    verdicts = [case.judge.all(case.stages)["train"] for case in cases]
    return [(case, verdict.state, verdict.stamp) for case, verdict in zip(cases, verdicts, strict=True)]


def announced(plan: list[tuple[Case, str, Stamp | None]]) -> str:
    """How much there is to do: '18 trainings: 6 cached, 12 to do, about 2h 10m'."""
    cached = [stamp.seconds for _, _, stamp in plan if stamp]
    left = len(plan) - len(cached)
    about = f", about {duration(left * fmean(cached))}" if cached and left else ""
    return f"{count(len(plan), 'training')}: {len(cached)} cached, {left} to do{about}"


class Quiet(Console):
    """Says nothing of stages that are fresh: after the first case they are the same ones."""

    def cached(self, stage: str, stamp: Stamp) -> None:
        """Not worth a row."""


def run(cases: list[Case], device: str, console: Console) -> dict[str, Any]:
    """Bring all cases up to date and compare them: `pipeline`, `seeds`, and `heldout`, see `compared`."""
    found: dict[str, list[dict[str, Any]]] = {}
    for i, case in enumerate(cases):
        if case.part in NEEDS_SCENE and found[""][0]["full"]["psnr"] is None:
            console.say(f"{case.judge.pipeline.name} is left out: it needs a scene, and this clip has none")
            continue
        console.say(f"{case.judge.pipeline.name}  seed {case.seed}   {i + 1} of {len(cases)}")
        ran = engine.run(case.judge, case.stages, frozenset(), device, Quiet() if i else console)
        found.setdefault(case.part, []).append(json.loads((ran[-1].folder / "metrics.json").read_bytes())["heldout"])
    name, seeds = cases[0].judge.pipeline.name, sorted({case.seed for case in cases})
    return {"pipeline": name, "seeds": seeds, "heldout": compared(name, found)}


def compared(name: str, found: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Of each variant, region and metric: the `values` of all seeds, their `mean` and `spread` (standard deviation),
    and the `difference` of the mean to the full method's; None where a seed has no value, or there is one seed."""
    table: dict[str, Any] = {}
    for part, seeds in found.items():
        rows = table[f"{name}.{part}" if part else name] = {}
        for region in REGIONS:
            rows[region] = {}
            for metric in METRICS:
                values = [metrics[region][metric] for metrics in seeds]
                mean = None if None in values else fmean(values)
                spread = stdev(values) if mean is not None and len(values) > 1 else None
                full = table[name][region][metric]["mean"] if part else None
                difference = None if mean is None or full is None else mean - full
                rows[region][metric] = {"mean": mean, "spread": spread, "difference": difference, "values": values}
    return table


def table(result: dict[str, Any]) -> list[str]:
    """The comparison as lines: a block for the whole picture and one for the person, a line a variant."""
    found, name, seeds = result["heldout"], result["pipeline"], result["seeds"]
    regions = [r for r in REGIONS if r != "person_white" and found[name][r]["psnr"]["mean"] is not None]
    spread = f"mean and standard deviation over {count(len(seeds), 'seed')}" if len(seeds) > 1 else "one seed"
    lines = [f"frames never trained on, {spread}, difference to {name}"]
    for region in regions or ["person_white"]:
        lines += ["", "".join([f"{REGIONS[region]:<26}", *(f"{metric.upper():<26}" for metric in METRICS)]).rstrip()]
        for variant, rows in found.items():
            cells = [f"{cell(rows[region][metric], digits):<26}" for metric, digits in METRICS.items()]
            lines.append("".join([f"{variant:<26}", *cells]).rstrip())
    return lines


def cell(numbers: dict[str, Any], digits: int) -> str:
    """'28.91 ±0.12  -0.34': mean, spread, difference; '-' where nothing was measured."""
    if numbers["mean"] is None:
        return "-"
    spread = "" if numbers["spread"] is None else f" ±{numbers['spread']:.{digits}f}"
    difference = "" if numbers["difference"] is None else f"  {numbers['difference']:+.{digits}f}"
    return f"{numbers['mean']:.{digits}f}{spread}{difference}"

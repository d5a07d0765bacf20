"""The paper's ablations on one clip: trains a pipeline and its variants over seeds, and tabulates the value of each part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hugs_cli import times
from hugs_cli.cache import engine
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.workspace import Stamp, read_json
from hugs_cli.console import Console
from hugs_cli.countdown import Countdown
from hugs_cli.device import device_of
from hugs_cli.pipelines import unknown
from hugs_cli.studies import comparison
from hugs_cli.studies.comparison import (
    LAST,
    METRICS,
    PAPERS,
    REGIONS,
    Case,
    Scores,
    cell,
    expected,
    heldout,
    over_seeds,
)
from hugs_cli.studies.variants import ABLATIONS
from hugs_cli.words import count
from stages.contract import load_stage

NEEDS_SCENE = ("no_human_loss", "no_joint")


def cases(session: Session, parts: Sequence[str], seeds: int) -> list[Case]:
    """Every training of a comparison, seed by seed, the full method first; without `parts`, of all that the pipeline has.

    UsageError for a part that is not known; "none" is no part.
    """
    for part in parts:
        if part not in (*ABLATIONS, "none"):
            raise unknown("part", part, [*ABLATIONS, "none"], "hugs ablate --part")
    left_out = lacking(session)
    chosen = (part for part in ABLATIONS if (not parts or part in parts) and part not in left_out)
    return comparison.cases(session, ("", *chosen), seeds)


def lacking(session: Session) -> list[str]:
    """The parts that a pipeline does not have, or has switched off already: without them it is itself."""
    session.pipeline.upstream(["train"])  # refuses a pipeline without it
    train = session.pipeline.stages["train"].params
    return [part for part, setting in ABLATIONS.items() if not getattr(train, setting, False)]


def plan(cases: list[Case]) -> list[tuple[Case, str, Stamp | None]]:
    """Each case, the state of its training (fresh, missing, stale, waits), and the stamp of a fresh one."""
    verdicts = [case.session.verdicts(case.stages)["train"] for case in cases]
    return [(case, verdict.state, verdict.stamp) for case, verdict in zip(cases, verdicts, strict=True)]


def summary(plan: list[tuple[Case, str, Stamp | None]], device: str) -> str:
    """One line: '18 trainings: 6 cached, 12 to do, about 2h 10m (between 1h 44m and 2h 42m)'."""
    left = sum(stamp is None for _, _, stamp in plan)
    said = f"{count(len(plan), 'training')}: {len(plan) - left} cached, {left} to do"
    guess = times.total(one for _, one in expected([case for case, _, _ in plan], device_of(device)[0]))
    return f"{said}, {times.said(guess)}" if left else said


def run(cases: list[Case], device: str, console: Console) -> dict[str, Any]:
    """Bring all cases up to date and compare them: `pipeline`, `seeds`, `heldout`, see `compared`, and `paper`, see
    `compare_with_paper`."""
    found: dict[str, list[Scores]] = {}
    ahead = expected(cases, device_of(device)[0])
    console.countdown = Countdown(ahead)
    for i, case in enumerate(cases):
        if case.variant in NEEDS_SCENE and found[""][0]["full"]["psnr"] is None:
            console.say(f"{case.session.pipeline.name} is left out: it needs a scene, and this clip has none")
            continue
        console.say(f"{case.session.pipeline.name}  seed {case.seed}   {i + 1} of {len(cases)}")
        console.only_new = i > 0
        ran = engine.run(case.session, case.stages, frozenset(), device, console)
        found.setdefault(case.variant, []).append(heldout(ran[-1].folder))
    name, seeds = cases[0].session.pipeline.name, sorted({case.seed for case in cases})
    paper = compare_with_paper(name, found, paper_scores(cases[0].session))
    return {"pipeline": name, "seeds": seeds, "heldout": compared(name, found), "paper": paper}


def paper_scores(session: Session) -> Mapping[str, Sequence[float | None]]:
    """Region -> the paper's scores on the sequence, see PAPERS; empty for other clips."""
    dataset = read_json(session.workspace.links / "frames" / "frames.json").get("dataset")
    published = load_stage(session.pipeline.stages[LAST].module).published
    return published(dataset["name"], dataset["sequence"]) if dataset and published else {}


def compare_with_paper(
    name: str, found: dict[str, list[Scores]], paper: Mapping[str, Sequence[float | None]]
) -> dict[str, Any]:
    """Region -> "HUGS, CVPR 2024" and each variant -> `over_seeds` of each of PAPERS; `paper`: region -> its scores."""
    table: dict[str, Any] = {}
    for region, theirs in paper.items():
        rows = table[region] = {
            f"{name}.{part}" if part else name: {
                m: over_seeds(one.get(region, {}).get(m) for one in seeds) for m in PAPERS
            }
            for part, seeds in found.items()
        }
        rows["HUGS, CVPR 2024"] = {metric: over_seeds([number]) for metric, number in zip(PAPERS, theirs, strict=True)}
    return table


def compared(name: str, found: dict[str, list[Scores]]) -> dict[str, Any]:
    """Of each variant, region and metric: `values`, `mean` and `spread` over seeds, and the `difference` of the mean to
    the full method's, None where there is none."""
    table: dict[str, Any] = {}
    for part, seeds in found.items():
        rows = table[f"{name}.{part}" if part else name] = {}
        for region in REGIONS:
            rows[region] = {}
            for metric in METRICS:
                numbers = over_seeds(metrics[region][metric] for metrics in seeds)
                full = table[name][region][metric]["mean"] if part else None
                known = numbers["mean"] is not None and full is not None
                rows[region][metric] = numbers | {"difference": numbers["mean"] - full if known else None}
    return table


def table(result: dict[str, Any]) -> list[str]:
    """The comparison as lines: a block for the whole picture, one for the person and one for the person over white."""
    found, name, seeds = result["heldout"], result["pipeline"], result["seeds"]
    spread = f"mean and standard deviation over {count(len(seeds), 'seed')}" if len(seeds) > 1 else "one seed"
    lines = [f"frames never trained on, {spread}, difference to {name}"]
    known = [region for region in REGIONS if found[name][region]["psnr"]["mean"] is not None]
    for region in known or ["person_white"]:
        lines += ["", "".join([f"{REGIONS[region]:<26}", *(f"{metric.upper():<26}" for metric in METRICS)]).rstrip()]
        lines += [row(variant, rows[region], METRICS) for variant, rows in found.items()]
    if result["paper"]:
        lines += ["", "beside the paper, measured as its code does"]
    for region, rows in result["paper"].items():
        head = [REGIONS.get(region, "person times mask"), "PSNR BY CHANNEL", "SSIM", "LPIPS ON 0..1"]
        lines += ["", "".join(f"{text:<26}" for text in head).rstrip()]
        lines += [row(variant, numbers, PAPERS) for variant, numbers in rows.items()]
    return lines


def row(name: str, numbers: dict[str, Any], metrics: dict[str, int]) -> str:
    """One line: a variant and its numbers of one region."""
    cells = [f"{cell(numbers[metric], digits):<26}" for metric, digits in metrics.items()]
    return "".join([f"{name:<26}", *cells]).rstrip()

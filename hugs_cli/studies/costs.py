"""Compares the pipelines that were run on a clip: time, memory, accuracy, and where more time stops paying."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any, TypeVar

from pydantic import BaseModel, FiniteFloat, ValidationError, model_validator

from hugs_cli.cache.fingerprint import digest
from hugs_cli.cache.workspace import Stamp, Workspace, result_behind
from hugs_cli.direct import run_directly
from hugs_cli.pipelines import UsageError
from hugs_cli.studies.comparison import LAST, METRICS, REGIONS, Scores, cell, measured, over_seeds
from hugs_cli.words import count, duration, size
from stages.contract import Job, StageError

WORTH = 0.1  # dB that a doubling of the time must buy
METRIC = "psnr"  # by which results are set against each other
SEED = re.compile(r"\.seed\d+$")
F = TypeVar("F", bound=BaseModel)


class Trained(BaseModel):
    """The part of train.json that is compared."""

    seconds: FiniteFloat


class Evaluated(BaseModel):
    """The part of metrics.json that is compared."""

    heldout: dict[str, dict[str, FiniteFloat | None]]
    gaussians: dict[str, int]

    @model_validator(mode="after")
    def whole(self) -> Evaluated:
        """ValueError if a region or metric is missing."""
        missing = [
            f"{region}.{metric}"
            for region in REGIONS
            for metric in METRICS
            if metric not in self.heldout.get(region, {})
        ]
        missing += [part for part in ("human", "scene") if part not in self.gaussians]
        if missing:
            raise ValueError(f"it has no {missing[0]}")
        return self


@dataclass(frozen=True)
class Run:
    """One finished pipeline: its costs from the video to the avatar, and its scores."""

    name: str
    """Of the pipeline or variant, without the seed."""
    seed: int
    seconds: dict[str, float]
    """Of each stage up to `train`."""
    peak_memory_bytes: int
    gaussians: dict[str, int]
    scores: Scores
    pictures: str
    """Digest of the frames and masks that it is measured on."""
    machine: str
    code: str
    """Digest of the code of training."""
    same: tuple[str, ...] = ()
    """Pipelines whose training is this very one."""


def run_of(links: Path) -> Run | None:
    """The last run of the pipeline whose links lie in a folder; None if it is not finished, or not measured since."""
    found = stamps(links)
    train, evaluate = found.get("train"), found.get(LAST)
    if train is None or evaluate is None or evaluate.inputs.get("train") != train.content:
        return None
    metrics = read(links / LAST / "metrics.json", Evaluated)
    before = upstream(found, "train")
    inputs = {name: content for stamp in before.values() for name, content in stamp.inputs.items()}
    seconds = {name: stamp.seconds for name, stamp in before.items()}
    seconds["train"] = max(train.seconds, read(links / "train" / "train.json", Trained).seconds)
    where = train.machine
    return Run(
        name=SEED.sub("", links.name),
        seed=train.seed,
        seconds=seconds,
        peak_memory_bytes=max(stamp.peak_memory_bytes for stamp in before.values()),
        gaussians=metrics.gaussians,
        scores=metrics.heldout,
        pictures=digest([inputs.get(name) for name in ("frames", "masks")]),
        machine=f"{where['host']} ({count(where['processors'], 'processor')}, {where['device']})",
        code=digest(train.code),
    )


def read(path: Path, form: type[F]) -> F:
    """A .json file read as `form`; StageError if it does not fit."""
    try:
        return form.model_validate_json(path.read_bytes(), strict=True)
    except (OSError, ValidationError) as error:
        hint = f"run the stage again: `hugs run VIDEO {path.parent.name} --force`"
        raise StageError(f"{path} is not as its stage writes it", hint, [str(error)]) from error


def stamps(links: Path) -> dict[str, Stamp]:
    """The stamps of all whole results that a pipeline's folder links to."""
    found = {link.name: Stamp.read(link) for link in sorted(links.iterdir()) if result_behind(link)}
    return {name: stamp for name, stamp in found.items() if stamp and not stamp.damage(links / name)}


def upstream(found: dict[str, Stamp], stage: str) -> dict[str, Stamp]:
    """The stamps of a stage and of all stages before it."""
    needed = {
        name: stamp for need in found[stage].inputs if need in found for name, stamp in upstream(found, need).items()
    }
    return needed | {stage: found[stage]}


def runs(workspace: Workspace) -> list[Run]:
    """Every finished pipeline of a clip; UsageError where there are fewer than two to compare."""
    folders = sorted({path.parent for path in workspace.root.glob("*/train") if result_behind(path)})
    found = {folder.name: run_of(folder) for folder in folders}
    same: dict[str, list[Run]] = {}
    for folder in folders:  # a pipeline that differs in nothing has the training of another one
        if run := found[folder.name]:
            same.setdefault(result_behind(folder / "train") or "", []).append(run)
    done = [replace(first, same=tuple(other.name for other in others)) for first, *others in same.values()]
    if len({run.name for run in done}) < 2:
        facts = [f"finished: {', '.join(sorted({run.name for run in done})) or 'none'}"]
        open_ = [name for name, run in found.items() if run is None]
        facts += [f"of one training: {', '.join((run.name, *run.same))}" for run in done if run.same]
        facts += [f"not finished, or trained again since it was measured: {', '.join(open_)}"] if open_ else []
        other = "default" if "preview" in found else "preview"
        hint = f"run another one: `hugs run VIDEO --pipeline {other}`, or try settings: `hugs costs VIDEO --sweep`"
        raise UsageError(f"fewer than two pipelines of {workspace.root} can be compared", hint, facts)
    return done


def compared(found: Sequence[Run]) -> dict[str, Any]:
    """The comparison: `rows`, quickest first, see `row`; `knee`, region -> pipeline; `notes`, what to know before
    trusting it.

    A row is on the `front` of a region if none that takes no longer is better there; `db_per_minute` is what it gains
    on the front over the row before it. Rows measured on other pictures than most are on no front.
    """
    names = dict.fromkeys(run.name for run in found)
    by_name = {name: [run for run in found if run.name == name] for name in names}
    rows = sorted((row(name, same) for name, same in by_name.items()), key=lambda row: row["seconds"]["total"])
    common = Counter(row["pictures"] for row in rows).most_common(1)[0][0]
    known = [row for row in rows if row["pictures"] == common]
    result: dict[str, Any] = {"rows": rows, "knee": {}, "notes": notes(found, rows, common)}
    for region in measured([row["scores"] for row in known]):
        points = [(row["seconds"]["total"], row["scores"][region][METRIC]["mean"]) for row in known]
        best = front(points)
        gains = [
            None,
            *((points[j][1] - points[i][1]) / (points[j][0] - points[i][0]) * 60 for i, j in zip(best, best[1:])),
        ]
        for i, gain in zip(best, gains, strict=True):
            known[i]["front"].append(region)
            known[i]["db_per_minute"][region] = gain
        if len(points) > 1:
            result["knee"][region] = known[knee(points)]["pipeline"]
    return result


def row(name: str, same: Sequence[Run]) -> dict[str, Any]:
    """One pipeline over its seeds: the least `seconds` of each stage, and their `total`; the mean of `gaussians`, the most
    of `peak_memory_bytes`, and `scores`, region -> metric -> `over_seeds`.

    Other load makes a training slower, and so does compiling in the first one: the least is its cost.
    """
    seconds = {stage: min(run.seconds[stage] for run in same) for stage in same[0].seconds}
    return {
        "pipeline": name,
        "seeds": [run.seed for run in same],
        "seconds": seconds | {"total": sum(seconds.values())},
        "peak_memory_bytes": max(run.peak_memory_bytes for run in same),
        "gaussians": {part: round(fmean(run.gaussians[part] for run in same)) for part in ("human", "scene")},
        "scores": {
            region: {metric: over_seeds(run.scores[region][metric] for run in same) for metric in METRICS}
            for region in REGIONS
        },
        "pictures": same[0].pictures,
        "front": [],
        "db_per_minute": {},
    }


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Rows of the (seconds, dB) that no other beats: by rising seconds, each with more dB than all before it."""
    best: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1])):
        if not best or points[i][1] > points[best[-1]][1]:
            best.append(i)
    return best


def knee(points: Sequence[tuple[float, float]]) -> int:
    """Row of the (seconds, dB) to stop at: every doubling of the time up to it bought WORTH dB or more, none after it does.

    This is the greatest dB - WORTH * log2(seconds): where a line that rises by WORTH a doubling touches the front from
    above. Of equals the quickest.
    """
    return max(range(len(points)), key=lambda i: (points[i][1] - WORTH * math.log2(points[i][0]), -points[i][0]))


def notes(found: Sequence[Run], rows: Sequence[dict[str, Any]], common: str) -> list[str]:
    """What makes the comparison less than fair."""
    said = []
    said += [f"{', '.join(run.same)}: the training of {run.name}, shown once" for run in found if run.same]
    apart = [row["pipeline"] for row in rows if row["pictures"] != common]
    if apart:
        said.append(f"measured on other frames, sizes or masks than the rest, so on no front: {', '.join(apart)}")
    if not measured([row["scores"] for row in rows]):
        said.append("they have no measured accuracy in common, so times and memory alone are compared")
    if len(machines := sorted({run.machine for run in found})) > 1:
        said.append(f"times are of different machines: {', '.join(machines)}")
    if len({run.code for run in found}) > 1:
        said.append("trained by different versions of the code; `hugs run` brings a pipeline up to date")
    return said


def table(result: dict[str, Any]) -> list[str]:
    """The comparison as lines: what each pipeline cost, then a block a region with what it bought."""
    rows = result["rows"]
    wide = max(26, *(len(row["pipeline"]) + 2 for row in rows))

    def line(*cells: str) -> str:
        return "".join(f"{text:<{width}}" for text, width in zip(cells, (wide, 26, 26, 26, 26))).rstrip()

    lines = []
    if "pipeline" in result:
        lines = [
            f"around {result['pipeline']}: mean, standard deviation over seeds, difference to it; ~ is no difference;"
            " times are the least",
            "",
        ]
    lines.append(line("video to avatar", "time", "of it training", "peak memory", "Gaussians, person + scene"))
    for row in rows:
        times = factor(row, "total"), factor(row, "train")
        made = f"{row['gaussians']['human']:,} + {row['gaussians']['scene']:,}"
        lines.append(line(row["pipeline"], *times, size(row["peak_memory_bytes"]), made))
    for region in measured([row["scores"] for row in rows]):
        lines += ["", line(REGIONS[region], *(metric.upper() for metric in METRICS), "dB per extra minute")]
        for row in rows:
            cells = [cell(row["scores"][region][metric], digits) for metric, digits in METRICS.items()]
            lines.append(line(row["pipeline"], *cells, front_text(row, region, result["knee"])))
    return [*lines, "", *(f"note: {note}" for note in result["notes"]), *advice(result)]


def factor(row: dict[str, Any], part: str) -> str:
    """'4m 10s x0.52': a time, and how many times that of the pipeline that the sweep varies."""
    times = row.get("times", {}).get(part)
    return duration(row["seconds"][part]) + ("" if times is None else f"  x{times:.2f}")


def front_text(row: dict[str, Any], region: str, knees: dict[str, str]) -> str:
    """Where a row is on the front: '+0.24  knee', 'first', or '-' if another is as quick and better."""
    if region not in row["front"]:
        return "-"
    gain = row["db_per_minute"][region]
    said = "first" if gain is None else f"{gain:+.2f}"
    return f"{said}  knee" if knees.get(region) == row["pipeline"] else said


def advice(result: dict[str, Any]) -> Iterable[str]:
    """The knees in words, a line a pipeline."""
    slowest: dict[str, Any] = max(
        (row for row in result["rows"] if row["front"]), key=lambda row: row["seconds"]["total"], default={}
    )
    for name in dict.fromkeys(result["knee"].values()):
        where = " and ".join(REGIONS[region] for region, one in result["knee"].items() if one == name)
        more = f"beyond it a doubling of the time buys less than {WORTH:g} dB"
        if name == slowest.get("pipeline"):
            more = f"each doubling of the time up to it bought {WORTH:g} dB or more; nothing slower was better"
        yield f"knee: {name} ({where}); {more}"


def write_page(folder: Path, name: str, title: str, result: dict[str, Any]) -> Path:
    """Write NAME.svg, NAME.png and NAME.html into the folder; returns the path of the page."""
    regions = {region: REGIONS[region] for region in measured([row["scores"] for row in result["rows"]])}
    inputs = {"result": result, "regions": regions, "table": table(result)}
    run_directly("stages.commands.costs_page", Job(folder), {"name": name, "title": title}, **inputs)
    return folder / f"{name}.html"

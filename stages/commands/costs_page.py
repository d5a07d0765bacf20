"""The plot and the page of a comparison of pipelines. No pipeline names it; `hugs costs --plot` runs it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from stages import contract
from stages.contract import Job, StageError, whole
from stages.formats import page, plot
from stages.formats.plot import Dot, Line, Panel

MINUTES = ("minutes from the video to the avatar", lambda row: row["seconds"]["total"] / 60)
MEMORY = ("peak memory, GiB", lambda row: row["peak_memory_bytes"] / 2**30)
PLOTS = (("psnr", "PSNR dB", MINUTES), ("lpips", "LPIPS (less is better)", MINUTES), ("psnr", "PSNR dB", MEMORY))


class Params(contract.Params):
    name: str
    """Of the three files, without suffix."""
    title: str


def run(
    job: Job, params: Params, *, result: Mapping[str, Any], regions: Mapping[str, str], table: Sequence[str]
) -> None:
    """Write NAME.svg, NAME.png and NAME.html.

    `result` is what `hugs costs --json` prints, `regions` the regions to draw with their names, `table` the same numbers
    as lines of text. StageError where there is no region to draw.
    """
    if not regions:
        hint = "leave out `--plot`: times and memory are compared without it"
        raise StageError("nothing to plot: these pipelines have no measured accuracy in common", hint)
    figure = plot.plot(panels(result, regions), len(regions))
    text = page.fill("costs.html", title=params.title, plot=Markup(plot.svg(figure)), lines=table)
    files = {"svg": plot.svg(figure, alone=True).encode(), "png": plot.png(figure), "html": text.encode()}
    for suffix, data in files.items():
        with whole(job.out / f"{params.name}.{suffix}") as part:
            part.write_bytes(data)


def panels(result: Mapping[str, Any], regions: Mapping[str, str]) -> list[Panel]:
    """Row by row, a column for each region. A metric that some pipeline lacks is not drawn."""
    rows, found = result["rows"], []
    for metric, y_name, (x_name, x_of) in PLOTS:
        if any(row["scores"][region][metric]["mean"] is None for row in rows for region in regions):
            continue
        for region in regions:
            dots = {}
            for row in rows:
                numbers, name = row["scores"][region][metric], row["pipeline"]
                spread = numbers.get("noise", numbers["spread"]) or 0.0
                dots[name] = Dot(x_of(row), numbers["mean"], spread, name)
            front = best(result, dots, region) if metric == "psnr" and x_of is MINUTES[1] else []
            if "pipeline" in result:
                lines = [*front, *swept(result, dots)]
            else:
                lines = [Line("", tuple(dots.values()), joined=False, ink="ink"), *front]
            found.append(Panel(x_name, f"{y_name}, {regions[region]}", tuple(lines), log=True))
    return found


def best(result: Mapping[str, Any], dots: dict[str, Dot], region: str) -> list[Line]:
    """A region's Pareto front as a line, its knee in its own colour; grey under the lines of a sweep."""
    inks = ("soft", "soft") if "pipeline" in result else ("blue", "mark")
    front = [bare(dots, row["pipeline"]) for row in result["rows"] if region in row["front"]]
    lines = [Line("Pareto front", tuple(sorted(front)), ink=inks[0])]
    if region in result["knee"]:
        lines.append(Line("knee", (bare(dots, result["knee"][region]),), ink=inks[1]))
    return lines


def bare(dots: dict[str, Dot], name: str) -> Dot:
    """The point of one pipeline, without its label."""
    return dots[name]._replace(label="", spread=0.0)


def swept(result: Mapping[str, Any], dots: dict[str, Dot]) -> list[Line]:
    """A line an axis through its levels and the pipeline, from the cheapest level on; then the pipeline."""
    base, *levels = result["rows"]
    middle, lines = dots[base["pipeline"]]._replace(label=""), []
    for axis in dict.fromkeys(row["axis"] for row in levels):
        own = sorted([*(row for row in levels if row["axis"] == axis), base], key=lambda row: row["expected_times"])
        through = [
            middle if row is base else dots[row["pipeline"]]._replace(label=level_of(row["pipeline"])) for row in own
        ]
        lines.append(Line(axis, tuple(through)))
    return [*lines, Line(base["pipeline"], (middle,), joined=False, ink="ink")]


def level_of(variant: str) -> str:
    """'default.caps_20000_40000' -> '20k 40k'."""
    return re.sub(r"000\b", "k", variant.partition("_")[2].replace("_", " "))

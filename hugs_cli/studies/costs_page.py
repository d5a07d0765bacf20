"""The comparison of `hugs costs` as a picture and as a page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hugs_cli.studies.comparison import REGIONS, measured
from hugs_cli.studies.costs import table
from stages.formats import page, plot
from stages.formats.images import write_image

MINUTES = ("minutes from the video to the avatar", lambda row: row["seconds"]["total"] / 60)
MEMORY = ("peak memory, GiB", lambda row: row["peak_memory_bytes"] / 2**30)
PLOTS = (("psnr", "PSNR dB", MINUTES), ("lpips", "LPIPS (less is better)", MINUTES), ("psnr", "PSNR dB", MEMORY))
NOTE = "Frames never trained on. Both scales of time and memory are logarithmic; bars are the standard deviation over seeds."


def panels(result: dict[str, Any]) -> tuple[list[plot.Panel], int]:
    """What is drawn, row by row, and how many columns: one for each region. A metric that some row lacks is not drawn."""
    rows, regions = result["rows"], measured([row["scores"] for row in result["rows"]])
    found = []
    for metric, said, (across, x_of) in PLOTS:
        if any(row["scores"][region][metric]["mean"] is None for row in rows for region in regions):
            continue
        for region in regions:
            dots = {}
            for row in rows:
                numbers, name = row["scores"][region][metric], row["pipeline"]
                spread = numbers.get("noise", numbers["spread"]) or 0.0
                dots[name] = plot.Dot(x_of(row), numbers["mean"], spread, name)
            front = best(result, dots, region) if metric == "psnr" and x_of is MINUTES[1] else []
            if "pipeline" in result:
                lines = [*front, *swept(result, dots)]
            else:
                lines = [plot.Line("", tuple(dots.values()), joined=False, ink="ink"), *front]
            found.append(plot.Panel(across, f"{said}, {REGIONS[region]}", tuple(lines), log=True))
    return found, len(regions)


def best(result: dict[str, Any], dots: dict[str, plot.Dot], region: str) -> list[plot.Line]:
    """The front of a region joined, its knee in a colour of its own; grey under the lines of a sweep."""
    inks = ("soft", "soft") if "pipeline" in result else ("blue", "mark")
    front = [bare(dots, row["pipeline"]) for row in result["rows"] if region in row["front"]]
    lines = [plot.Line("Pareto front", tuple(sorted(front)), ink=inks[0])]
    if region in result["knee"]:
        lines.append(plot.Line("knee", (bare(dots, result["knee"][region]),), ink=inks[1]))
    return lines


def bare(dots: dict[str, plot.Dot], name: str) -> plot.Dot:
    """The point of one pipeline, without its label."""
    return dots[name]._replace(label="", spread=0.0)


def swept(result: dict[str, Any], dots: dict[str, plot.Dot]) -> list[plot.Line]:
    """A line an axis through its levels and the pipeline, from the cheapest level on; then the pipeline."""
    base, *levels = result["rows"]
    middle, lines = dots[base["pipeline"]]._replace(label=""), []
    for axis in dict.fromkeys(row["axis"] for row in levels):
        own = sorted([*(row for row in levels if row["axis"] == axis), base], key=lambda row: row["expected_times"])
        through = [
            middle if row is base else dots[row["pipeline"]]._replace(label=level_of(row["pipeline"])) for row in own
        ]
        lines.append(plot.Line(axis, tuple(through)))
    return [*lines, plot.Line(base["pipeline"], (middle,), joined=False, ink="ink")]


def level_of(variant: str) -> str:
    """'default.caps_20000_40000' -> '20k 40k'."""
    return re.sub(r"000\b", "k", variant.partition("_")[2].replace("_", " "))


def write(folder: Path, name: str, title: str, result: dict[str, Any]) -> Path:
    """Write NAME.svg, NAME.png and NAME.html into the folder; returns the path of the page."""
    drawn = plot.drawing(*panels(result))
    (folder / f"{name}.svg").write_text(plot.svg(drawn, alone=True), encoding="utf-8")
    write_image(folder / f"{name}.png", plot.pixels(drawn))
    parts = [
        f"<h1>{page.escape(title)}</h1>",
        page.section("What it costs, what it buys", plot.svg(drawn), note=NOTE),
        page.section("In numbers", page.lines(table(result))),
    ]
    path = folder / f"{name}.html"
    path.write_text(page.page(title, parts), encoding="utf-8")
    return path

"""What docs/benchmarks/table.json is shown as: a table, a plot, and marked numbers anywhere in the documents.

    python -m tests.benchmarks.page        writes them again

A block between `<!-- table -->` and `<!-- end -->` in a document is made from the table, and so is a number with a mark behind
it, as `29.2<!-- kitchen.default.heldout.full.psnr -->`: the mark leads to the value, the number keeps its decimals.
tests/docs/test_numbers.py fails where a document and the table differ.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from typing import Any

from hugs_cli.words import duration
from stages.formats import plot
from stages.formats.plot import Dot, Line, Panel
from tests.made.command import ROOT

FOLDER = ROOT / "docs" / "benchmarks"
TABLE, PLOT = FOLDER / "table.json", FOLDER / "time.svg"
HEAD = (
    "| clip | pipeline | time | memory | whole picture | person | new views | new poses | empty scene |\n"
    "|---|---|---|---|---|---|---|---|---|"
)
PERSON = ("person_crop", "person_white")
"""Where the person is compared: in the picture, or over white where there is no scene."""
NOWHERE = "–"
BLOCK = re.compile(r"(<!-- (table|about|phone) -->\n).*?(?=<!-- end -->)", re.DOTALL)
NUMBER = re.compile(r"(-?\d[\d,]*(?:\.(\d+))?)(<!-- ([a-z]\w*(?:\.\w+)+) -->)")


def scored(regions: dict[str, dict[str, float | None]] | None, *names: str) -> str:
    """PSNR, SSIM and LPIPS of the first of these regions in which they were measured; a dash if in none."""
    for name in names:
        found = (regions or {}).get(name)
        if found and found["psnr"] is not None:
            return f"{found['psnr']:.1f} / {found['ssim']:.3f} / {found['lpips']:.3f}"
    return NOWHERE


def line(clip: str, pipeline: str, row: dict[str, Any]) -> str:
    """A row of the table."""
    if "failed" in row:
        return f"| {clip} | `{pipeline}` | fails: {row['failed']} | | | | | | |"
    back, far = row.get("held_back", {}), scored(row.get("heldout_far"), *PERSON)
    poses = scored(back.get("poses"), *PERSON)
    poses = f"farthest: {far}" if "poses" not in back and far != NOWHERE else poses
    cells = [
        clip,
        f"`{pipeline}`",
        duration(60 * row["minutes"]),
        f"{row['gib']:.1f} GiB",
        scored(row["heldout"], "full"),
        scored(row["heldout"], *PERSON),
        scored(back.get("views"), *PERSON),
        poses,
        scored(back.get("empty"), "full"),
    ]
    return f"| {' | '.join(cells)} |"


def rows(table: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """(clip, pipeline, row) of the whole table."""
    for clip, found in table["rows"].items():
        for pipeline, row in found.items():
            yield clip, pipeline, row


def as_table(table: dict[str, Any]) -> str:
    """The table in Markdown."""
    return "\n".join([HEAD, *(line(*row) for row in rows(table))]) + "\n"


def about(table: dict[str, Any]) -> str:
    """Of which commit, machine and seed it is."""
    where = table["machine"]
    libraries = ", ".join(f"{name} {where[name]}" for name in ("python", "torch", "numba", "numpy"))
    return (
        f"Commit {table['commit']}, seed {table['seed']}, one run each, on {where['cores']} cores "
        f"of {where['processor']} ({libraries}).\n"
    )


def phone(table: dict[str, Any]) -> str:
    """What README shows: the phone clip."""
    lines = ["| phone clip, 6.4 s | video to report | memory | PSNR, whole / person |", "|---|---|---|---|"]
    for pipeline, row in table["rows"]["kitchen"].items():
        psnr = [scored(row["heldout"], name).partition(" ")[0] for name in ("full", PERSON[0])]
        lines.append(
            f"| `{pipeline}` | {duration(60 * row['minutes'])} | {row['gib']:.1f} GiB | {' / '.join(psnr)} dB |"
        )
    return "\n".join(lines) + "\n"


BLOCKS: dict[str, Callable[[dict[str, Any]], str]] = {"table": as_table, "about": about, "phone": phone}


def fill(text: str, table: dict[str, Any]) -> str:
    """A document with its blocks and marked numbers as the table has them; KeyError for a mark that leads nowhere."""

    def number(match: re.Match[str]) -> str:
        clip, pipeline, *path = match[4].split(".")
        value = table["rows"][clip][pipeline]
        for key in path:
            value = value[key]
        return f"{value:,.{len(match[2] or '')}f}{match[3]}"

    return NUMBER.sub(number, BLOCK.sub(lambda match: match[1] + BLOCKS[match[2]](table), text))


def drawn(table: dict[str, Any]) -> str:
    """Accuracy against time, as SVG: a line a clip, a point a pipeline, named at the first clip."""
    panels = []
    for metric, name in (("psnr", "PSNR of the person, dB"), ("lpips", "LPIPS of the person")):
        lines = []
        for clip, found in table["rows"].items():
            dots = [
                Dot(
                    row["minutes"],
                    next(value for part in PERSON if (value := row["heldout"][part][metric])),
                    0.0,
                    "" if lines else one,
                )
                for one, row in found.items()
                if "failed" not in row
            ]
            if dots:
                lines.append(Line(clip, tuple(dots)))
        panels.append(Panel("minutes, video to report", f"{name}, at {table['commit']}", tuple(lines), log=True))
    return plot.svg(plot.plot(panels, 2), alone=True)


def keep(table: dict[str, Any]) -> None:
    """Write the table alone, also while rows that the documents speak of are missing."""
    TABLE.write_text(json.dumps(table, indent=1) + "\n")


def write(table: dict[str, Any]) -> None:
    """Write the plot and the documents; KeyError for a mark that leads nowhere."""
    if any("failed" not in row for _, _, row in rows(table)):
        PLOT.write_text(drawn(table))
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        text = path.read_text(encoding="utf-8")
        if (filled := fill(text, table)) != text:
            path.write_text(filled, encoding="utf-8")


if __name__ == "__main__":
    write(json.loads(TABLE.read_bytes()))

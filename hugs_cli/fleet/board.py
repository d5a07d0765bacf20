"""How a fleet is doing: a row a clip, from the plan and from what its jobs report; as a page, a table and JSON."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hugs_cli.cache.whole import replace
from hugs_cli.cache.workspace import read_json
from hugs_cli.direct import run_directly
from hugs_cli.fleet.job import LOGS, ROWS, SNAKEMAKE_LOG, STOP
from hugs_cli.fleet.plan import AFTER, BEFORE, WHOLE, Planned
from hugs_cli.pipelines import UsageError
from stages.contract import Job

SILENT = 60.0  # s without a beat, after which a page says that there is no sign of life
OPEN = ("waiting", "running", "before")  # states of jobs that may still end well
WELL, FAILED = ("fresh", "done"), ("failed", "lost")
NAMES = re.compile(r"'[^']*'|\"[^\"]*\"|`[^`]*`|\S*/\S*|\S+\.\w{2,4}\b")
AGAIN = "call the fleet again: what is finished is kept"
NEVER: dict[str, Any] = {
    "problem": "its job never began",
    "hint": AGAIN,
    "facts": ["the log says why"],
}
GONE: dict[str, Any] = {"problem": "its process ended without a report", "hint": AGAIN,
        "facts": ["the machine is gone, the process was killed, or it could not write its report"]}  # fmt: skip
CSV = ("clip", "folder", "pipeline", "state", "stage", "seconds_left", "seconds", "psnr", "psnr_person", "effects",
       "warnings", "kind", "problem", "hint", "log")  # fmt: skip


class Board:
    """The rows of a fleet's run. Reads only the reports that have changed."""

    def __init__(self, folder: Path, work: Path, planned: Sequence[Planned]):
        self.folder, self.work, self.planned = folder, work, planned
        self.reports: dict[str, dict[str, Any]] = {}
        self.changed: dict[str, tuple[int, float]] = {}
        """Row -> mtime of its report, and when that was seen, by our clock."""

    def look(self, over: bool = False) -> None:
        """Read what jobs report now; `over`: all of it, since the times of files and lists of names may lag behind."""
        if over:
            for one in self.planned:
                self.take(one.row.id, 0)
            return
        with suppress(OSError), os.scandir(self.folder / ROWS) as files:
            for file in files:
                row, suffix = os.path.splitext(file.name)
                with suppress(OSError):
                    stamp = file.stat().st_mtime_ns if suffix == ".json" else 0
                    if stamp and stamp != self.changed.get(row, (0, 0))[0]:
                        self.take(row, stamp)

    def take(self, row: str, stamp: int) -> None:
        """Keep a row's report, if it is there and can be read."""
        if report := read_json(self.folder / ROWS / f"{row}.json"):
            self.reports[row], self.changed[row] = report, (stamp, time.monotonic())

    def kind(self, row: str) -> str:
        """The kind of a row's failure, from its report as it is now; '' where it has not failed."""
        report = read_json(self.folder / ROWS / f"{row}.json")
        return str(report.get("kind", "")) if report.get("state") == "failed" else ""

    def rows(self, over: bool = False) -> list[dict[str, Any]]:
        """A row a clip, in order. `over`: no job runs any more, so one that did not end is lost."""
        return [self.row(one, over) for one in self.planned]

    def row(self, one: Planned, over: bool) -> dict[str, Any]:
        """What is known of one clip."""
        report = self.reports.get(one.row.id, {})
        state, stage = report.get("state", one.state), report.get("stage", "")
        said: dict[str, Any] = report or {"problem": one.problem, "hint": one.hint, "facts": one.facts}
        if over and state in (*OPEN, "todo"):
            if (self.folder / STOP).exists() and state != "running":
                state = "stopped"
            else:
                said, state = NEVER if state in ("todo", "before") else GONE, "lost"
        logs = [self.folder / LOGS / f"{one.row.id}.{step}.log" for step in (AFTER, BEFORE, WHOLE)]
        logs += [self.folder / SNAKEMAKE_LOG] if state == "lost" else []
        log = next((file for file in logs if file.exists()), None) if state in ("failed", "lost") else None
        result = report.get("result") or one.result
        silent = self.silent(one.row.id) if state == "running" else 0.0
        return {
            "clip": one.row.name,
            "folder": os.path.relpath(one.row.root, self.work),
            "pipeline": one.row.pipeline,
            "state": state,
            "stage": stage if state in (*OPEN, "failed", "lost") else "",
            "percent": round(100 * report["done"] / report["total"]) if report.get("total") else None,
            "silent": round(silent) if silent > SILENT else None,
            "seconds_left": self.left(one, report, state),
            "seconds": result.get("seconds"),
            "spent": report.get("spent", 0.0),
            "kept": result.get("kept", []),
            "freed": result.get("freed", 0) if report else 0,
            "psnr": result.get("psnr"),
            "psnr_person": result.get("psnr_person"),
            "effects": result.get("effects", []),
            "warnings": result.get("warnings", []),
            "kind": kind_of(stage, said.get("problem", "")) if state in ("failed", "lost") else "",
            "problem": said.get("problem", "") if state in ("failed", "lost") else "",
            "hint": said.get("hint", "") if state in ("failed", "lost") else "",
            "facts": said.get("facts", []) if state in ("failed", "lost") else [],
            "log": os.path.relpath(log, self.work) if log else "",
            "picture": result.get("picture", ""),
            "pages": result.get("pages", []),
        }

    def silent(self, row: str) -> float:
        """Seconds since a report last changed. Our clock alone: machines may differ about the time."""
        return time.monotonic() - self.changed[row][1]

    def left(self, one: Planned, report: dict[str, Any], state: str) -> float:
        """Seconds until a row is done, once it runs; 0 where nothing is left."""
        if state not in (*OPEN, "todo"):
            return 0.0
        finished = {*report.get("finished", ()), report.get("stage", "")}
        rest = sum(seconds for stage, seconds in one.expected.items() if stage not in finished)
        if state != "running":
            return rest
        now = report.get("left")
        return rest + (one.expected.get(report["stage"], 0.0) if now is None else now)


def kind_of(stage: str, problem: str) -> str:
    """A failure without what differs from clip to clip: names and numbers."""
    plain = re.sub(r"\d+(\.\d+)?", "N", NAMES.sub("...", problem))
    return f"{stage}: {plain}" if stage else plain


def totals(rows: Sequence[dict[str, Any]], side_by_side: int) -> dict[str, Any]:
    """Counts of states and of kinds of failure, machine time, and about how long it will still take: with `side_by_side`
    clips at a time, or as many as run now."""
    left = [row["seconds_left"] for row in rows]
    kinds = Counter(row["kind"] for row in rows if row["kind"])
    together = max(1, side_by_side, sum(row["state"] == "running" for row in rows))
    return {
        "states": dict(Counter(row["state"] for row in rows)),
        "failures": dict(kinds.most_common()),
        "machine_seconds": round(sum(row["seconds"] or 0.0 for row in rows), 1),
        "spent_seconds": round(sum(row["spent"] for row in rows), 1),
        "freed_bytes": sum(row["freed"] for row in rows),
        "seconds_left": round(max(sum(left) / together, *left)) if left else 0,
    }


def write(work: Path, name: str, rows: Sequence[dict[str, Any]], total: dict[str, Any], live: bool) -> None:
    """Write NAME.html and NAME.csv into the work folder, each whole and in one step."""
    inputs = {"name": name, "rows": rows, "totals": total, "live": live}
    run_directly("stages.commands.fleet_page", Job(work), None, **inputs)
    text = io.StringIO()
    table = csv.DictWriter(text, CSV, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    for row in rows:
        cells = row | {column: "; ".join(row[column]) for column in ("effects", "warnings")}
        table.writerow({name: plain_cell(cell) for name, cell in cells.items()})
    replace(work / f"{name}.csv", text.getvalue())


def plain_cell(cell: Any) -> Any:
    """A cell as tables show it: a text that they would take for a formula gets a ' before it."""
    if not isinstance(cell, str):
        return cell
    cell = cell.replace("\r", " ")  # which ends a line, and csv does not quote it
    return f"'{cell}" if cell.lstrip()[:1] in tuple("=+-@") else cell


def as_json(rows: Sequence[dict[str, Any]], total: dict[str, Any]) -> str:
    """The same for programs: totals, each kind of failure with what helps and its clips, all rows."""
    return json.dumps({"totals": total, "failures": failures(rows), "rows": list(rows)}, indent=1)


def failures(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each kind of failure, the most frequent first: its stage, what the first of its clips says, and all their folders."""
    kinds: dict[str, dict[str, Any]] = {}
    for row in rows:
        if kind := row["kind"]:
            first = {"kind": kind, "clips": [], **{name: row[name] for name in ("stage", "problem", "hint")}}
            kinds.setdefault(kind, first)["clips"].append(f"{row['folder']}/{row['pipeline']}")
    return sorted(kinds.values(), key=lambda one: -len(one["clips"]))


def last_states(work: Path, name: str) -> dict[tuple[str, str], str]:
    """The states of a fleet's rows when its table was last written, by folder and pipeline as the table has them; UsageError
    where there is no table."""
    path = work / f"{name}.csv"
    try:
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            return {(row["folder"], row["pipeline"]): row["state"] for row in csv.DictReader(file)}
    except (OSError, KeyError, csv.Error) as error:
        hint = "leave out `--only-failed`, or name the fleet with `--name`"
        raise UsageError(f"there is no table of an earlier call at {path}", hint, [str(error)]) from error


def failed_before(planned: Sequence[Planned], work: Path, name: str) -> list[Planned]:
    """The rows that failed, or were lost, when the fleet was last called, or that cannot begin now; and those that are made."""
    states = last_states(work, name)

    def last(one: Planned) -> str:
        folder = os.path.relpath(one.row.root, work)
        return states.get((plain_cell(folder), plain_cell(one.row.pipeline)), "")

    return [one for one in planned if one.state != "todo" or not one.todo or last(one) in FAILED]

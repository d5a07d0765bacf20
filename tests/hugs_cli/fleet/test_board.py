"""The rows of a fleet: from the plan, and from reports that may stop coming."""

from __future__ import annotations

import csv
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest

from hugs_cli.fleet import board
from hugs_cli.fleet.board import Board, kind_of, totals
from hugs_cli.fleet.clips import Row
from hugs_cli.fleet.job import LOGS, ROWS, SNAKEMAKE_LOG, STOP
from hugs_cli.fleet.plan import Planned
from hugs_cli.pipelines import UsageError
from tests.made.said import holds

EXPECTED = {"frames": 10.0, "train": 100.0}


@pytest.fixture
def show(tmp_path) -> Board:
    """Two clips to do, one fresh."""
    for room in (ROWS, LOGS):
        (tmp_path / "run" / room).mkdir(parents=True)
    stages = ["frames", "train"]
    result = {"seconds": 7.0, "psnr": 28.5, "effects": ["shadow"], "warnings": ["train: dark"], "pages": []}
    planned = [Planned(Row(Path(f"{n}.mp4"), tmp_path, "default"), "todo", stages, stages, EXPECTED) for n in "ab"]
    planned.append(Planned(Row(Path("c.mp4"), tmp_path, "default"), "fresh", stages, result=result))
    return Board(tmp_path / "run", tmp_path, planned)


def report(show: Board, number: int, **facts: object) -> Path:
    file = show.folder / ROWS / f"{show.planned[number].row.id}.json"
    file.write_text(json.dumps(facts))
    show.look()
    return file


def test_time_left(show):
    report(show, 0, state="running", stage="train", finished=["frames"], done=1, total=4, left=30.0)
    rows = show.rows()
    assert [row["seconds_left"] for row in rows] == [30.0, 110.0, 0.0] and rows[0]["percent"] == 25
    assert totals(rows, 2)["seconds_left"] == 110 and totals(rows, 1)["seconds_left"] == 140
    report(show, 0, state="running", stage="frames", left=None)
    assert show.rows()[0]["seconds_left"] == 110.0
    show.planned[0].slowed(2.0)
    assert show.rows()[0]["seconds_left"] == 220


def test_the_last_report_counts_whatever_its_time_says(show):
    """Some file systems tell the time in seconds, others show old times for a minute."""
    file = report(show, 0, state="running", stage="train")
    seen = file.stat().st_mtime_ns
    file.write_text(json.dumps({"state": "done", "result": {"seconds": 5.0}}))
    os.utime(file, ns=(seen, seen))
    show.look()
    assert show.rows()[0]["state"] == "running"
    show.look(over=True)
    assert [row["state"] for row in show.rows(over=True)] == ["done", "lost", "fresh"]
    file.write_text("{")  # half of it, and what was known stays
    show.look(over=True)
    assert show.rows(over=True)[0]["seconds"] == 5.0


def test_what_is_lost_has_a_log(show):
    report(show, 0, state="running", stage="train")
    report(show, 1, state="before", stage="")
    (show.folder / LOGS / f"{show.planned[0].row.id}.clip.log").touch()
    (show.folder / SNAKEMAKE_LOG).touch()
    lost, never, _ = show.rows(over=True)
    assert lost["log"].endswith("clip.log") and holds(lost["problem"], "ended")
    assert never["log"].endswith(SNAKEMAKE_LOG) and "never began" in never["problem"]


def test_silence_is_said_and_in_the_end_it_is_lost(show, monkeypatch):
    report(show, 0, state="running", stage="train", beat=1)
    assert show.rows()[0]["silent"] is None
    later = board.time.monotonic() + 100
    monkeypatch.setattr(board.time, "monotonic", lambda: later)
    assert show.rows()[0]["silent"] >= 100
    report(show, 0, state="running", stage="train", beat=22)
    assert show.rows()[0]["silent"] is None
    lost, never, _ = show.rows(over=True)
    assert lost["state"] == never["state"] == "lost"
    assert holds(lost["problem"], "ended") and holds(never["problem"], "never", "began") and never["hint"]
    (show.folder / STOP).touch()
    assert [row["state"] for row in show.rows(over=True)] == ["lost", "stopped", "fresh"]


def test_kinds_leave_out_what_differs_from_clip_to_clip():
    one, two = ("no person in {} of {} frames of 'clips/{}.mp4'".format(*x) for x in ((3, 40, "a"), (12, 9, "b c")))
    kind = kind_of("masks", one)
    assert kind == kind_of("masks", two) != kind_of("sfm", one) and holds(kind, "masks", "N of N") and "mp4" not in kind
    assert kind_of("", "no video at clips/x.mp4") == "no video at ..."


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", '=HYPERLINK("x")'])
def test_no_text_of_the_table_is_a_formula(show, text):
    rows = [
        row | {"clip": text, "problem": text, "warnings": [text], "effects": [text], "psnr": -1.5}
        for row in show.rows()
    ]
    board.write(show.work, "fleet", rows, totals(rows, 1), live=False)
    with open(show.work / "fleet.csv", newline="") as file:
        for row in csv.DictReader(file):
            assert {row[name] for name in ("clip", "problem", "warnings", "effects")} == {"'" + text.replace("\r", " ")}
            assert row["psnr"] == "-1.5", "numbers stay"


def test_page_and_table_hold_the_same(show):
    text = "<script>alert(1)</script>"
    report(show, 0, state="failed", stage="train", kind="error", problem=text, hint="film again", facts=["1 < 2"])
    rows = show.rows(over=True)
    total = totals(rows, 1)
    board.write(show.work, "fleet", rows, total, live=True)
    page = (show.work / "fleet.html").read_text()
    own = re.search(r"script-src 'nonce-([0-9a-f]+)';", page)
    assert own and page.count("<script") == page.count(f'<script nonce="{own[1]}">')
    assert text not in page and "&lt;script&gt;alert(1)" in page and "film again" in page and "location.reload" in page
    assert total["failures"] == {"train: ...": 1, "its job never began": 1}
    with open(show.work / "fleet.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["state"] for row in table] == ["failed", "lost", "fresh"] and table[0]["hint"] == "film again"
    assert table[2]["psnr"] == "28.5" and table[2]["effects"] == "shadow" and table[2]["warnings"] == "train: dark"
    assert json.loads(board.as_json(rows, total))["rows"] == rows


def test_failures_of_a_kind_are_told_together(show):
    for number in (0, 1):
        problem = f"no person in any of {40 + number} frames of '{number}.mp4'"
        report(show, number, state="failed", stage="masks", problem=problem, hint="film one")
    rows = show.rows(over=True)
    (kind,) = json.loads(board.as_json(rows, totals(rows, 1)))["failures"]
    assert kind["clips"] == ["a/default", "b/default"] and (kind["stage"], kind["hint"]) == ("masks", "film one")
    assert holds(kind["problem"], 40) and "N frames" in kind["kind"]


def test_what_failed_is_known_from_the_table_of_the_last_call(show):
    report(show, 1, state="failed", stage="train", problem="dark")
    board.write(show.work, "fleet", show.rows(), totals(show.rows(), 1), live=True)  # and then it was killed
    assert [one.row.name for one in board.failed_before(show.planned, show.work, "fleet")] == ["b", "c"]
    made = [replace(show.planned[0], todo=[]), *show.planned[1:]]  # its other results are to be let go
    assert [one.row.name for one in board.failed_before(made, show.work, "fleet")] == ["a", "b", "c"]
    board.write(show.work, "fleet", show.rows(over=True), totals(show.rows(over=True), 1), live=False)
    again = board.failed_before(show.planned, show.work, "fleet")
    assert [one.row.name for one in again] == ["a", "b", "c"]  # the first is lost; what is fresh stays on the page
    with pytest.raises(UsageError, match=r"other\.csv"):
        board.failed_before(show.planned, show.work, "other")

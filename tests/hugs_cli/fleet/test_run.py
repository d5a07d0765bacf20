"""A fleet that lost its place to another call, and one that finds what an earlier call left."""

from __future__ import annotations

import io
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from hugs_cli.console import Console
from hugs_cli.fleet import lease as leases
from hugs_cli.fleet.clips import Row
from hugs_cli.fleet.plan import Common, Planned
from hugs_cli.fleet.run import Fleet, Press
from stages.contract import StageError
from tests.made.said import holds


@pytest.fixture
def call(tmp_path) -> Fleet:
    """One call, with nothing to do."""
    found = Fleet("fleet", Common(tmp_path / "work"), [], False, 1, None)
    found.folder.mkdir(parents=True)
    return found


def test_a_fleet_that_another_call_took_the_place_of_ends(call):
    me = leases.identity()
    path = call.folder / leases.NAME
    assert leases.take(path, me)
    jobs, press = SimpleNamespace(going=lambda: True), SimpleNamespace(print_if_due=lambda: None)
    call.wait(jobs, press, leases.Lease(path, me), longest=0.3)
    leases.remove(path, me)
    with pytest.raises(StageError, match=re.escape(str(path))):
        call.wait(jobs, press, leases.Lease(path, me), longest=30)


def test_what_earlier_calls_left_is_taken_away(call):
    """Also what jobs still write, which is no longer heard."""
    call.lay_out(call.folder / "01d01d01d01d", {}, [])
    (call.folder / "notes").mkdir()  # of somebody
    (call.folder / "01d01d01d01d" / "logs" / "a.log").touch()
    with leases.lease(call.folder / leases.NAME, pytest.fail):
        call.lay_out(call.folder / "new", {}, [])
        assert sorted(path.name for path in call.folder.iterdir()) == [leases.NAME, "new", "notes"]


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_each_running_clip_with_stage_and_time_left(call, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("LINES", "5")
    err = Terminal()
    planned = [Planned(Row(Path(f"{n}.mp4"), Path("work"), "draft"), "todo", ["train"], ["train"]) for n in "abcdef"]
    press = Press(call, SimpleNamespace(planned=planned), Console(err=err))
    blank = {
        "seconds": None,
        "silent": None,
        "percent": None,
        "problem": "",
        "freed": 0,
        "stage": "",
        "seconds_left": None,
    }
    rows = [blank | {"folder": n, "pipeline": "draft", "state": "todo"} for n in "abcdef"]
    total = {"states": {"running": 2, "todo": 4}, "seconds_left": 400.0}
    rows[0] |= {"state": "running", "stage": "train", "percent": 43, "seconds_left": 130.0}
    rows[1] |= {"state": "running", "stage": "sfm", "silent": 90}
    press.speak(rows, total, False)
    shown = err.getvalue().rpartition("\x1b")[2].partition("K")[2].split("\n")
    assert [holds(line, *facts) for line, facts in zip(shown, (("a", "train", "43", "2m 10s"), ("b", "sfm", "1m 30s")))]
    assert holds(shown[2], "2 running", "4 to do") and len(shown) == 3

    err.seek(err.truncate(0))
    for row in rows:
        row |= {"state": "running", "stage": "train"}
    rows[0] |= {"state": "done", "seconds": 65.0, "freed": 3 << 20}
    press.speak(rows, total, False)
    wiped, shown = err.getvalue().split("\x1b[J", 1)
    assert wiped == "\x1b[2A\r" and holds(shown, "done", "a", "draft", "1m 05s", "3 MiB freed")
    assert len(shown.split("\n")) <= 1 + 4 and holds(shown, "and 3 more")  # of a window of five lines
    press.speak([row | {"state": "done"} for row in rows], total, True)
    assert err.getvalue().endswith("f  draft\n")

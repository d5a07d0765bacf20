"""Golden texts: what a person sees. `HUGS_GOLDEN=write` writes them anew, to be read before they are committed."""

from __future__ import annotations

import io
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from hugs_cli.cache.engine import StageFailed
from hugs_cli.cache.freshness import (
    CodeChanged,
    Damaged,
    FirstRun,
    InputChanged,
    ParamChanged,
    SeedChanged,
    Unfinished,
    Upstream,
    Verdict,
)
from hugs_cli.cache.launcher import Outcome
from hugs_cli.cache.workspace import Stamp
from hugs_cli.console import Console
from hugs_cli.times import Guess
from hugs_cli.words import duration, number, size
from tests.made.said import holds

GOLDEN = Path(__file__).parents[1] / "golden"


def check(name: str, text: str) -> None:
    """Compare a text with its golden file."""
    file = GOLDEN / f"{name}.txt"
    if os.environ.get("HUGS_GOLDEN") == "write":
        file.write_text(text)
    assert text == file.read_text()


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def stamp(stage: str, **facts) -> Stamp:
    values = {
        "stage": stage,
        "key": "3f2a9c1b77",
        "seed": 0,
        "code": {"stages.train": "1", "stages.training.step.losses": "2", "stages.contract": "3"},
        "params": {"steps": 7000, "sh_degree": 1, "lr": 0.1},
        "inputs": {"frames": "a", "sfm": "b", "body_model": None},
        "content": "c",
        "files": {},
        "made": (datetime.now(UTC) - timedelta(days=2, hours=1)).isoformat(timespec="seconds"),
        "seconds": 521.0,
        "peak_memory_bytes": 2**31,
        "machine": {"host": "box", "device": "cpu", "processors": 2, "versions": {"torch": "2.12.0", "numpy": "2.4.6"}},
    }
    return Stamp(**{**values, **facts})


def a_run(console: Console, clock: list[float]) -> None:
    """Five stages of a run, as the engine tells them."""
    console.header("dance.mp4", "12.4 s, 372 frames, 1280x720", "default", "work/dance", "cpu", "as asked")
    console.cached("frames", stamp("frames", seconds=4.1))
    console.cached("sfm", stamp("sfm", seconds=151.0, warnings=["static camera: the scene cannot be had"]))
    guesses = {"smpl": 4.0, "survey": 2.0, "train": 640.0, "evaluate": 90.0}
    console.expect([(name, Guess(seconds, 1.5)) for name, seconds in guesses.items()], lambda todo: {})
    console.started("smpl", (ParamChanged("smooth_hz", 4, 6),))
    console.ended("smpl", Outcome("done", seconds=3.2))
    console.started("survey", (InputChanged("smpl"),))
    notes = ["exposure off, pose refinement on (jitter 3.1 px)"]
    console.ended(
        "survey", Outcome("done", seconds=1.04, notes=notes, warnings=["the feet leave the picture in 12 frames"])
    )
    console.started("train", (CodeChanged("stages.training.step.losses", "edited"),))
    for done, passed in ((10, 0.1), (2000, 70.0), (4200, 146.0)):
        clock[0] = 100 + passed
        numbers = {"psnr": 27.14, "gaussians": 142_012, "memory_bytes": int(2.1 * 2**30)}
        console.heard("train", {"event": "progress", "done": done, "total": 15000, "numbers": numbers})
    clock[0] = 247.0
    console.heard("train", {})
    notes = ["held-out psnr 28.4 dB", "stopped early at step 12000: nothing gained over 2000 steps", "142012 gaussians"]
    console.ended("train", Outcome("done", seconds=612.0, notes=notes))


def test_a_stage_that_knows_how_long_it_takes_is_believed():
    clock, err = [0.0], io.StringIO()
    console = Console(io.StringIO(), err, lambda: clock[0])
    console.started("train", ())
    for done, now in ((25, 70.0), (50, 140.0)):
        clock[0] = now
        console.heard("train", {"event": "progress", "done": done, "total": 1000, "numbers": {}, "left": 100.0})
    assert err.getvalue().count("1m 40s") == 2


def test_what_cannot_wait_is_said_at_once_and_once():
    err = io.StringIO()
    console = Console(io.StringIO(), err, lambda: 0.0)
    console.started("train", ())
    console.heard("train", {"event": "note", "text": "812 steps fit into the time", "at_once": True})
    assert err.getvalue().count("\n") == 1 and holds(err.getvalue(), "train", "812 steps")
    console.heard("train", {"event": "note", "text": "40 frames"})
    console.ended("train", Outcome("done", seconds=3.0, notes=["812 steps fit into the time", "40 frames"]))
    assert err.getvalue().count("812 steps") == 1 and "40 frames" in err.getvalue()


def test_a_run_without_a_terminal():
    clock, err = [100.0], io.StringIO()
    a_run(Console(io.StringIO(), err, lambda: clock[0]), clock)
    check("run", err.getvalue())


def test_a_run_on_a_terminal_moves_one_row(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    clock, err = [100.0], Terminal()
    a_run(Console(io.StringIO(), err, lambda: clock[0]), clock)
    check("run_live", err.getvalue().replace("\r\x1b[2K", "<wipe>"))


def test_errors():
    out, err = io.StringIO(), io.StringIO()
    console = Console(out, err)
    facts = ["longest run: frames 112-152; median 38 matches a pair outside it"]
    hint = "the clip may turn too fast for the frame rate; try `--set sfm.overlap=24`"
    console.error(StageFailed("SfM placed only 41 of 300 frames (needs 150)", hint, facts))
    console.stopped("train", True)
    console.stopped("sfm", False)
    console.stopped("", False)
    console.waiting("process 4711")
    bug = StageFailed("stage train has a bug: KeyError: 'x'", "this is a fault in hugs")
    bug.traceback = "Traceback (most recent call last):\n  ...\nKeyError: 'x'\n"
    console.error(bug)
    assert out.getvalue() == ""
    check("errors", err.getvalue())


def test_why_and_status():
    out = io.StringIO()
    console = Console(out, io.StringIO())
    last = stamp("train")
    reasons = (
        CodeChanged("stages.training.step.losses", "edited"),
        ParamChanged("steps", 7000, 15000),
        InputChanged("sfm"),
        SeedChanged(0, 1),
        Unfinished(True),
    )
    now = {"torch": "2.13.0+cpu", "numpy": "2.4.6"}
    stale = Verdict("train", reasons, last=last)
    waits = Verdict("render", (Upstream(("train",)),), last=stamp("render", seconds=31.0))
    fresh = Verdict("sfm", (), None, Path("x"), stamp("sfm", warnings=["static camera"]))
    many = Verdict("export", tuple(CodeChanged(f"stages.m{i}", "edited") for i in range(5)), last=last)
    for verdict in (stale, waits, fresh, Verdict("report", (FirstRun(),)), many):
        console.why(verdict, now)
        console.result()
    damaged = Verdict("masks", (Damaged("masks/000001.png is missing"),), last=last)
    verdicts = [fresh, damaged, stale, many, waits, Verdict("report", (FirstRun(), Upstream(("train",))))]
    console.verdicts({verdict.stage: verdict for verdict in verdicts})
    check("why_and_status", out.getvalue())


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0.0 s"), (59.94, "59.9 s"), (59.96, "1m 00s"), (3599.6, "1h 00m"), (5000, "1h 23m")]
)
def test_durations(seconds, text):
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (1023, "1023 B"), (1024, "1 KiB"), (3 * 2**20, "3 MiB"), (2**41, "2048.0 GiB")]
)
def test_sizes(count, text):
    assert size(count) == text


def test_numbers_read_as_words():
    assert number("psnr", 27.14) == "psnr 27.1"
    assert number("gaussians", 142_012) == "142k gaussians"
    assert number("gaussians", 9_999) == "9999 gaussians"
    assert number("gaussians", 2_300_000) == "2.3M gaussians"
    assert number("memory_bytes", 2**31) == "2.0 GiB"
    assert number("phase", "mapping") == "phase mapping"

"""However a command fails, it ends as stages do: in words, with a hint, and with a traceback only where hugs has a bug."""

from __future__ import annotations

import errno
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from hugs_cli import app, direct
from hugs_cli.cache.engine import RunStopped
from hugs_cli.direct import run_directly
from stages.contract import Job, Params, StageError
from tests.made.said import holds

LONG = "a" * 300
ERRORS = {
    "bug": (ValueError("not here"), ("compose", "bug", "ValueError: not here"), "report"),
    "deep": (RecursionError("too deep"), ("compose", "bug", "RecursionError"), "report"),
    "memory": (MemoryError(), ("memory",), "close"),
    "torch": (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), ("memory",), "close"),
    "full": (OSError(errno.ENOSPC, "No space left"), ("disk", "full"), "free"),
    "gone": (FileNotFoundError(errno.ENOENT, "No such file", "a.ply"), ("a.ply",), "put it back"),
    "forbidden": (PermissionError(errno.EACCES, "no", "a.ply"), ("a.ply",), "readable"),
    "long": (OSError(errno.ENAMETOOLONG, "File name too long", LONG), ("name", "too long"), "shorter"),
    "words": (StageError("no motion 'x'", "a .bvh"), ("no motion 'x'",), "a .bvh"),
}


@pytest.mark.parametrize("kind", ERRORS)
def test_any_error_of_a_stage_that_runs_here_is_said(monkeypatch, kind):
    error, problem, hint = ERRORS[kind]

    def fail(job: Job, params: Params) -> None:
        raise error

    monkeypatch.setattr(direct, "load_stage", lambda name: SimpleNamespace(params=Params, run=fail))
    with pytest.raises(StageError) as caught:
        run_directly("stages.commands.compose", Job(Path()))
    assert holds(caught.value.problem, *problem) and holds(caught.value.hint, hint)
    assert bool(getattr(caught.value, "traceback", "")) == (kind in ("bug", "deep"))


@pytest.mark.parametrize("kind", ERRORS)
@pytest.mark.parametrize("command", ["run", "compose", "animate", "render", "view", "gc", "fleet", "costs"])
def test_any_error_of_any_command_is_said(monkeypatch, capsys, kind, command):
    error, problem, hint = ERRORS[kind]

    def fail() -> None:
        raise error

    monkeypatch.setattr(app, "app", fail)
    monkeypatch.setattr(app.signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["hugs", command])
    with pytest.raises(SystemExit) as end:
        app.main()
    err = capsys.readouterr().err
    facts = [f"hugs {command}" if fact == "compose" else fact for fact in problem]
    assert end.value.code == 1 and holds(err, "error", *facts, "hint", hint)
    assert ("Traceback" in err) == (kind in ("bug", "deep"))


def test_a_request_to_stop_is_no_error_that_a_stage_could_swallow(monkeypatch):
    def careless(job: Job, params: Params) -> None:
        try:
            raise RunStopped("", False)
        except Exception:
            pytest.fail("it went on")

    monkeypatch.setattr(direct, "load_stage", lambda name: SimpleNamespace(params=Params, run=careless))
    with pytest.raises(RunStopped):
        run_directly("stages.commands.compose", Job(Path()))


@pytest.mark.parametrize(
    "given",
    [
        ["run", LONG + ".mp4"],
        ["run", "clip.mp4", "--within", "9" * 5000 + "m"],
        ["run", "clip.mp4", "--masks", LONG],
        ["run", "clip.mp4", "--work", LONG],
        ["render", "--avatar", LONG + ".npz", "--out", "x"],
        ["animate", "--avatar", "a.npz", LONG + ".bvh"],
        ["compose", LONG + ".yaml"],
        ["compose", "--init", LONG],
        ["gc", LONG + ".mp4"],
        ["fleet", LONG + ".mp4", "--dry-run"],
        ["stages", "--set", "render.motion_seconds=.inf"],
        ["stages", "--set", "render.motion_seconds=1e300"],
        ["stages", "--set", "train.half_until=.nan"],
        ["stages", "--set", "train.steps=" + "9" * 5000],
        ["stages", "--pipelines-file", LONG],
    ],
    ids=lambda given: " ".join(one[:30] for one in given),
)
def test_names_and_numbers_of_any_length_are_refused_in_words(tmp_path, monkeypatch, capsys, given):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.mp4").write_text("pixels")
    (tmp_path / "a.npz").write_text("")
    monkeypatch.setattr(app.signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["hugs", *given])
    with pytest.raises(SystemExit) as end:
        app.main()
    err = capsys.readouterr().err
    assert end.value.code in (1, 2) and "Traceback" not in err and "bug" not in err and len(err) < 3000

"""The processes of stages: what they hold, how they are stopped, and that the next one loads ahead."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest

from hugs_cli.cache.launcher import Launcher, Process


def job_of(module: str, out: Path, **params: int) -> dict[str, object]:
    """The job of a stage without inputs."""
    facts = {"inputs": {}, "upstream": {}, "device": "cpu", "seed": 0, "resumes": False}
    return facts | {"module": module, "params": params, "out": str(out)}


STAGE = """
import os
import signal
from stages.contract import Params as Base

class Params(Base):
    handle: int

def run(job, params):
    (job.out / "seen").write_text(str(os.fstat(params.handle).st_ino))
"""


@pytest.mark.slow
def test_the_lock_is_handed_to_the_stage(tmp_path, monkeypatch):
    """It belongs to the open file: a stage that outlives its run holds the clip until it ends."""
    (tmp_path / "holds_the_lock.py").write_text(STAGE)
    monkeypatch.syspath_prepend(str(tmp_path))
    handle = os.open(tmp_path / ".lock", os.O_RDWR | os.O_CREAT)
    try:
        job = job_of("holds_the_lock", tmp_path, handle=handle)
        outcome = Launcher(handle).launch(job, tmp_path / "log", lambda event: None)
        assert outcome.kind == "done", (tmp_path / "log").read_text()
        assert int((tmp_path / "seen").read_text()) == os.fstat(handle).st_ino
    finally:
        os.close(handle)


QUICK = """
from stages.contract import Params

def run(job, params):
    (job.out / "made").touch()
"""


def test_a_stop_that_comes_as_the_stage_has_just_ended_loses_nothing(tmp_path, monkeypatch):
    (tmp_path / "over_at_once.py").write_text(QUICK)
    monkeypatch.syspath_prepend(str(tmp_path))
    job = job_of("over_at_once", tmp_path)
    handle = os.open(tmp_path / ".lock", os.O_RDWR | os.O_CREAT)

    def heard(event):
        if event.get("event") == "done":
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)  # its process has ended, and nobody has asked how
            os.kill(os.getpid(), signal.SIGINT)

    try:
        outcome = Launcher(handle).launch(job, tmp_path / "log", heard)
        assert outcome.kind == "done" and outcome.asked
    finally:
        os.close(handle)


LASTING = """
import os
import time
from stages.contract import Params

def run(job, params):
    (job.out / "process").write_text(str(os.getpid()))
    job.note("here")
    time.sleep(600)
"""


def has_ended(process: int) -> bool:
    """Whether a process that this one started has ended; nobody else may have asked."""
    try:
        return os.waitpid(process, os.WNOHANG)[0] == process
    except ChildProcessError:
        return True


def test_a_run_whose_screen_is_gone_ends_and_its_stage_with_it(tmp_path, monkeypatch):
    (tmp_path / "lasts.py").write_text(LASTING)
    monkeypatch.syspath_prepend(str(tmp_path))
    job = job_of("lasts", tmp_path)
    handle = os.open(tmp_path / ".lock", os.O_RDWR | os.O_CREAT)

    def heard(event):
        if event.get("event") == "note":
            raise BrokenPipeError("nobody reads what is printed")

    try:
        with pytest.raises(BrokenPipeError):
            Launcher(handle).launch(job, tmp_path / "log", heard)
        process, end = int((tmp_path / "process").read_text()), time.monotonic() + 60
        while not has_ended(process):
            assert time.monotonic() < end, "the stage goes on"
            time.sleep(0.02)
    finally:
        os.close(handle)


HALF = """
import json
import os
import sys
from stages.contract import Params

def run(job, params):
    job.progress(1, 2)
    (job.out / "process").write_text(str(os.getpid()))
    (job.out / "loaded").write_text(json.dumps([name in sys.modules for name in ("wave", "colorsys")]))
    print("said")
"""


def test_the_next_process_is_started_ahead_and_loads_its_libraries(tmp_path, monkeypatch):
    (tmp_path / "is_half_done.py").write_text(HALF)
    monkeypatch.syspath_prepend(str(tmp_path))
    handle, places = os.open(tmp_path / ".lock", os.O_RDWR | os.O_CREAT), [tmp_path / name for name in "abc"]
    launcher = Launcher(handle)
    try:
        ahead = []
        for place in places:
            place.mkdir()
            then = ("wave", "no_such_library") if place is not places[-1] else None
            outcome = launcher.launch(job_of("is_half_done", place), place / "log", lambda event: None, then)
            assert outcome.kind == "done", (place / "log").read_text()
            assert (place / "log").read_text() == "said\n"  # where its own job says, whatever it did before
            ahead.append(launcher.ahead and launcher.ahead.id)
        ran = [int((place / "process").read_text()) for place in places]
        assert ran[1:] == ahead[:2] and ahead[2] is None and ran[0] not in ran[1:]
        loaded = [json.loads((place / "loaded").read_text()) for place in places]
        assert loaded == [[False, False], [True, False], [True, False]]
    finally:
        launcher.close()
        os.close(handle)


COMPILES = """
from stages.contract import Params

def run(job, params):
    import numba
    numba.njit(lambda n: n + 1)(1)
    (job.out / "made").touch()
"""


@pytest.mark.slow
def test_a_stage_that_compiles_says_for_how_long(tmp_path, monkeypatch):
    (tmp_path / "compiles_once.py").write_text(COMPILES)
    monkeypatch.syspath_prepend(str(tmp_path))
    handle = os.open(tmp_path / ".lock", os.O_RDWR | os.O_CREAT)
    launcher = Launcher(handle)
    launcher.ahead = Process(handle, ("numba",))
    try:
        outcome = launcher.launch(job_of("compiles_once", tmp_path), tmp_path / "log", lambda event: None)
        assert 0 < outcome.compiling < outcome.seconds, (tmp_path / "log").read_text()
    finally:
        os.close(handle)


def test_a_process_that_died_before_its_turn_is_replaced(tmp_path, monkeypatch):
    (tmp_path / "over_at_once.py").write_text(QUICK)
    monkeypatch.syspath_prepend(str(tmp_path))
    job = job_of("over_at_once", tmp_path)
    handle = os.open(tmp_path / ".lock", os.O_RDWR | os.O_CREAT)
    launcher = Launcher(handle)
    launcher.ahead = Process(handle)
    os.kill(launcher.ahead.id, signal.SIGKILL)
    os.waitid(os.P_PID, launcher.ahead.id, os.WEXITED | os.WNOWAIT)
    try:
        assert launcher.launch(job, tmp_path / "log", lambda event: None).kind == "done"
    finally:
        os.close(handle)


def test_a_process_that_waits_for_a_job_that_never_comes_is_ended(tmp_path):
    handle = os.open(tmp_path / ".lock", os.O_RDWR | os.O_CREAT)
    launcher = Launcher(handle)
    launcher.ahead = Process(handle)
    process = launcher.ahead.id
    launcher.close()
    os.close(handle)
    with pytest.raises(ChildProcessError):
        os.waitpid(process, 0)

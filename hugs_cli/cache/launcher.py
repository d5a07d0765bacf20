"""Runs each stage in a process of its own, with `child.py` on the other side.

Loading torch takes 2 s: so the process of the next stage is started while a stage still runs, and loads its libraries
until it gets its job.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hugs_cli.cache import child
from stages.contract import MAXRSS

TICK = 0.25  # s between looks at the clock
AHEAD = 0.5  # of a stage's progress, from which on the next one's process may load


@dataclass
class Outcome:
    """How a stage's process ended."""

    kind: str
    """done, error (StageError), crash (a bug), killed (by a signal), stopped (asked to)."""
    facts: dict[str, Any] = field(default_factory=dict)
    """The last event: versions; or problem, facts, hint; or traceback; or signal."""
    seconds: float = 0.0
    compiling: float = 0.0
    """Seconds of these in which kernels were compiled, once for this machine."""
    peak_memory_bytes: int = 0
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    asked: bool = False
    """Whether it was asked to stop, also where it ended well just then."""


class Launcher:
    """Runs one stage after the other, each in a process of its own that holds the handle `lock`, too."""

    def __init__(self, lock: int):
        self.lock = lock
        self.ahead: Process | None = None

    def launch(
        self, job: dict[str, Any], log: Path, heard: Callable[[dict[str, Any]], None], then: Sequence[str] | None = None
    ) -> Outcome:
        """Run one job (see `engine.make`) to its end; `heard` gets each event and {} each tick.

        SIGINT and SIGTERM are passed on once as a request to stop; the second time the process is killed. `then` names the
        libraries of the stage that comes next: its process is started ahead; None: there is none.
        """
        started = time.monotonic()
        process, self.ahead = self._first(log), None
        asked: list[int] = []

        def stop(signum: int, frame: Any) -> None:
            asked.append(signum)
            with suppress(ProcessLookupError):  # send_signal would reap a process that has just ended
                os.kill(process.id, signal.SIGTERM if len(asked) == 1 else signal.SIGKILL)

        listens = threading.current_thread() is threading.main_thread()  # no other may, and none else is interrupted
        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM) if listens}
        outcome = Outcome("killed")
        try:
            process.give({**job, "log": str(log.absolute()), "path": sys.path})
            for event in events(process.events, process.id, heard):
                if event["event"] in ("note", "warning"):
                    said = outcome.notes if event["event"] == "note" else outcome.warnings
                    if event["text"] not in said:  # a stage may begin twice, as train does when it chooses its sizes
                        said.append(event["text"])
                elif event["event"] in ("done", "error", "crash", "stopped"):
                    outcome.kind, outcome.facts = event["event"], event
                elif then is not None and not self.ahead and far_enough(event):
                    self.ahead = Process(self.lock, then)
                heard(event)
            code, usage = process.wait()
        finally:
            process.close()  # where this side has failed, the stage ends
            for number, handler in before.items():
                signal.signal(number, handler)
        outcome.seconds = time.monotonic() - started
        outcome.compiling = outcome.facts.get("compiling", 0.0)
        outcome.peak_memory_bytes = max(usage.ru_maxrss * MAXRSS, outcome.facts.get("peak_memory_bytes", 0))
        if code < 0 or (code and outcome.kind in ("done", "killed")):
            outcome.kind = "killed"
            outcome.facts = {"signal": -code, "exit": code}
        outcome.asked = bool(asked)
        if asked and outcome.kind != "done":
            outcome.kind = "stopped"
        return outcome

    def check(self, jobs: list[dict[str, Any]]) -> dict[str, Any] | None:
        """Let stages check what they are given (see `checks.check`), in the process that runs the next stage.

        Returns the event of the first that refuses it, with the stage's name; None if none does.
        """
        self.ahead, stage = Process(self.lock), ""
        self.ahead.give({"checks": jobs, "path": sys.path})
        for event in events(self.ahead.events, self.ahead.id, lambda event: None):
            if event["event"] == "checked":
                return None
            stage = event.get("stage", stage)
            if event["event"] != "checks":
                return {**event, "stage": stage}
        code, _ = self.ahead.wait()
        problem = f"the check of the inputs of stage {stage} was ended by signal {-code}"
        return {"event": "error", "stage": stage, "problem": problem, "hint": "see whether memory ran out", "facts": []}

    def _first(self, log: Path) -> Process:
        """The process that was started ahead, unless it has died; else a new one, which writes to `log` from its start."""
        if self.ahead and self.ahead.popen.poll() is None:
            log.touch()
            return self.ahead
        if self.ahead:
            self.ahead.close()
        with open(log, "ab") as output:
            return Process(self.lock, output=output.fileno())

    def close(self) -> None:
        """End a process that waits for a job that never came."""
        if self.ahead:
            self.ahead.popen.kill()
            self.ahead.popen.wait()
            self.ahead.close()
            self.ahead = None


class Process:
    """The process of a stage, which loads `libraries` until it is given its job; `events` is the end of a pipe to read."""

    def __init__(self, lock: int, libraries: Sequence[str] = (), output: int = subprocess.DEVNULL):
        self.events, self.write = os.pipe()
        self.popen = subprocess.Popen(
            [sys.executable, "-P", child.__file__, *libraries],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            pass_fds=(self.write, lock),
            start_new_session=True,
        )
        os.close(self.write)

    @property
    def id(self) -> int:
        return self.popen.pid

    def give(self, job: dict[str, Any]) -> None:
        """Tell it what to do."""
        assert self.popen.stdin
        with suppress(BrokenPipeError):  # it died before it read its job
            self.popen.stdin.write(json.dumps({**job, "events": self.write}).encode() + b"\n")
            self.popen.stdin.flush()

    def wait(self) -> tuple[int, resource.struct_rusage]:
        """Its exit code, negative for a signal, and what it used; once it has ended."""
        _, status, usage = os.wait4(self.id, 0)
        self.popen.returncode = os.waitstatus_to_exitcode(status)
        return self.popen.returncode, usage

    def close(self) -> None:
        """Let go of it: it ends unless it has ended."""
        assert self.popen.stdin
        os.close(self.events)
        with suppress(BrokenPipeError):
            self.popen.stdin.close()


def far_enough(event: dict[str, Any]) -> bool:
    """Whether a stage says that it has done AHEAD of its work."""
    return bool(event["event"] == "progress" and event["done"] >= AHEAD * event["total"])


def events(pipe: int, process: int, heard: Callable[[dict[str, Any]], None]) -> Iterator[dict[str, Any]]:
    """The events that come through a pipe, until its other end is closed or the process is gone."""
    rest = b""
    while True:
        if not select.select([pipe], [], [], TICK)[0]:
            # A worker that the stage left behind may hold the pipe open for ever.
            if os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                return
            heard({})
            continue
        data = os.read(pipe, 65536)
        if not data:
            return
        *lines, rest = (rest + data).split(b"\n")
        yield from map(json.loads, lines)

"""Runs each stage in a process of its own, with `child.py` on the other side.

Loading torch takes 2 s. So it is loaded by a process of which each stage gets a copy; and where the next stage needs libraries
that are not loaded, such a process is started beside a stage.
"""

from __future__ import annotations

import json
import os
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
        self.process: Process | None = None
        self.ahead: Process | None = None
        """The one that loads the libraries of the next stage, where `process` does not have them."""

    def launch(
        self, job: dict[str, Any], log: Path, heard: Callable[[dict[str, Any]], None], then: Sequence[str] | None = None
    ) -> Outcome:
        """Run one job (see `engine.make`) to its end; `heard` gets each event and {} each tick.

        SIGINT and SIGTERM are passed on once as a request to stop; the second time the process is killed. `then` names the
        libraries of the stage that comes next; None: there is none.
        """
        started = time.monotonic()
        process = self.process = self._first(log)
        asked: list[int] = []
        copy = 0

        def stop(signum: int, frame: Any) -> None:
            asked.append(signum)
            if copy:
                with suppress(ProcessLookupError):  # it has just ended
                    os.kill(copy, signal.SIGTERM if len(asked) == 1 else signal.SIGKILL)

        listens = threading.current_thread() is threading.main_thread()  # no other may, and none else is interrupted
        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM) if listens}
        outcome, code, peak_memory = Outcome("killed"), None, 0
        try:
            process.give({**job, "log": str(log.absolute()), "path": sys.path})
            for event in events(process.events, process.id, heard):
                if event["event"] == "exit":
                    code, peak_memory, copy = event["code"], event["peak_memory"], 0
                    break
                if event["event"] == "begun":
                    copy = event["process"]
                    if asked:
                        with suppress(ProcessLookupError):
                            os.kill(copy, signal.SIGTERM)
                    if then is not None and not process.has(then):
                        self.ahead = Process(self.lock, then)
                    continue
                if event["event"] in ("note", "warning"):
                    said = outcome.notes if event["event"] == "note" else outcome.warnings
                    if event["text"] not in said:  # a stage may begin twice, as train does when it chooses its sizes
                        said.append(event["text"])
                elif event["event"] in ("done", "error", "crash", "stopped"):
                    outcome.kind, outcome.facts = event["event"], event
                heard(event)
        finally:
            copy = 0
            if code is None:  # it was killed, or this side has failed: then the stage ends
                self.process = None
                process.close()
            elif self.ahead:
                self.process = None
                process.end()
            for number, handler in before.items():
                signal.signal(number, handler)
        code = process.wait() if code is None else code
        outcome.seconds = time.monotonic() - started
        outcome.compiling = outcome.facts.get("compiling", 0.0)
        outcome.peak_memory_bytes = max(peak_memory * MAXRSS, outcome.facts.get("peak_memory_bytes", 0))
        if code < 0 or (code and outcome.kind in ("done", "killed")):
            outcome.kind = "killed"
            outcome.facts = {"signal": -code, "exit": code}
        outcome.asked = bool(asked)
        if asked and outcome.kind != "done":
            outcome.kind = "stopped"
        return outcome

    def check(self, jobs: list[dict[str, Any]]) -> dict[str, Any] | None:
        """Let stages check what they are given (see `checks.check`), in a copy of the process that the next stage gets one of.

        Returns the event of the first that refuses it, with the stage's name; None if none does.
        """
        process, stage, last, code = Process(self.lock), "", {"event": ""}, 0
        self.process = process
        process.give({"checks": jobs, "path": sys.path})
        for event in events(process.events, process.id, lambda event: None):
            stage = event.get("stage", stage)
            if event["event"] == "exit":
                code = event["code"]
                break
            last = event
        if last["event"] == "checked":
            return None
        if last["event"] in ("error", "crash"):
            return {**last, "stage": stage}
        problem = f"the check of the inputs of stage {stage} was ended by signal {-(code or process.wait())}"
        return {"event": "error", "stage": stage, "problem": problem, "hint": "see whether memory ran out", "facts": []}

    def _first(self, log: Path) -> Process:
        """The process for the next stage, unless it has died; else a new one, which writes to `log` from its start."""
        process, self.ahead = self.ahead or self.process, None
        if process and process.popen.poll() is None:
            log.touch()
            return process
        if process:
            process.close()
        with open(log, "ab") as output:
            return Process(self.lock, output=output.fileno())

    def close(self) -> None:
        """End the processes, which wait for jobs that never come."""
        for process in filter(None, (self.process, self.ahead)):
            process.end()
        self.process = self.ahead = None


class Process:
    """The process of stages, which loads `libraries` until it is given a job; `events` is the end of a pipe to read."""

    def __init__(self, lock: int, libraries: Sequence[str] = (), output: int = subprocess.DEVNULL):
        self.libraries = frozenset(libraries)
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

    def has(self, libraries: Sequence[str]) -> bool:
        """Whether it has loaded these libraries."""
        return self.libraries.issuperset(libraries)

    def give(self, job: dict[str, Any]) -> None:
        """Tell it what to do."""
        assert self.popen.stdin
        with suppress(BrokenPipeError):  # it died before it read its job
            self.popen.stdin.write(json.dumps({**job, "events": self.write}).encode() + b"\n")
            self.popen.stdin.flush()

    def wait(self) -> int:
        """Its exit code, negative for a signal, once it has ended."""
        self.popen.returncode = os.waitstatus_to_exitcode(os.waitpid(self.id, 0)[1])
        return self.popen.returncode

    def end(self) -> None:
        """End it while it waits for a job."""
        self.popen.kill()
        self.popen.wait()
        self.close()

    def close(self) -> None:
        """Let go of it: it ends unless it has ended, and so does what it does."""
        assert self.popen.stdin
        os.close(self.events)
        with suppress(BrokenPipeError):
            self.popen.stdin.close()


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
        for line in lines:
            try:
                event = json.loads(line)
            except ValueError:  # a killed process left a part of a line
                continue
            yield event

"""Keeps a pipeline's report going while its stages run: a process of its own makes the page of what is there to be seen."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from hugs_cli.cache.fingerprint import digest
from hugs_cli.cache.freshness import Session, Verdict
from hugs_cli.cache.launcher import Process, events
from hugs_cli.cache.whole import replace
from hugs_cli.cache.workspace import read_json
from hugs_cli.direct import failed
from stages.contract import StageError, StageRecord

PAGE, STATE, LOG = "report.html", ".report.json", ".report.log"  # in the pipeline's folder
EVERY = 5.0  # s between words on how far a stage is
PATIENCE = 60.0  # s, at most, that a run which failed or was stopped waits for its page


class Report:
    """The report of one run of a pipeline, made by `module`. Its process starts with the first stage that is made."""

    def __init__(self, session: Session, module: str, wanted: list[str], lock: int):
        self.session, self.module, self.lock = session, module, lock
        self.place = session.workspace.links
        self.rows: dict[str, dict[str, Any]] = {name: {"name": name, "state": "waits"} for name in wanted}
        self.done: dict[str, Verdict] = {}
        self.process: Process | None = None
        self.now, self.written = "", 0.0

    def has(self, name: str, verdict: Verdict) -> None:
        """A result is there."""
        self.done[name] = verdict
        known = {field.name: getattr(verdict.made, field.name) for field in fields(StageRecord)}
        self.rows[name] = {"name": name, "state": "done", "folder": os.path.abspath(str(verdict.folder)), **known}
        self.now = ""
        if self.process:
            self.write()

    def begins(self, name: str, part: Path) -> None:
        """A stage is being made."""
        self.rows[name] |= {"state": "running", "folder": os.path.abspath(part)}
        self.write()
        if self.process is None:
            self.process = self._start()

    def heard(self, event: Mapping[str, Any], left: str) -> None:
        """A stage has reported something; `left` says how long it will take."""
        if event.get("event") == "progress":
            self.now = f"{100 * event['done'] // max(event['total'], 1)} %, {left}".removesuffix(", ")
            if time.monotonic() - self.written > EVERY:
                self.write()

    def write(self, **facts: Any) -> None:
        """Write down what there is to be seen. A full disk hurts the page, not the result."""
        clip = os.fsencode(self.session.video.name).decode(errors="replace")
        state = {"clip": clip, "pipeline": self.session.pipeline.name, "now": self.now}
        self.written = time.monotonic()
        with suppress(OSError):
            replace(
                self.place / STATE, json.dumps({**state, "stages": list(self.rows.values()), "over": False, **facts})
            )

    def end(self, session: Session) -> None:
        """The page as it stays, of what there is and of other fresh results of a session; made only where it shows something
        else. StageError where it cannot be made."""
        found = dict(self.done)
        for name, stage in session.pipeline.stages.items():
            if name not in found:
                found[name] = session.verdict(stage, found)
        shown = {name: found[name] for name in session.pipeline.stages if found[name].fresh}
        made_of = digest([session.code.digests(self.module), {name: one.made.content for name, one in shown.items()}])
        if (
            not self.process
            and (self.place / PAGE).exists()
            and read_json(self.place / STATE).get("made_of") == made_of
        ):
            return
        self.rows = {}
        for name, verdict in shown.items():
            self.has(name, verdict)
        self.write(over=True)
        ended = self._end(self.process) if self.process else None
        if ended is None:  # none was needed so far, or it was killed
            ended = self._end(self._start())
        self.process = None
        if ended is None or ended["event"] != "done":
            lost = {"event": "error", "problem": "the report was not made", "hint": "run again", "facts": []}
            raise failed(ended or lost, "the report", str(self.place / LOG))
        self.write(over=True, made_of=made_of)

    def fails(self, error: BaseException) -> None:
        """A stage has failed, or the run was stopped: the page says so, and stays."""
        for row in self.rows.values():
            if row["state"] == "running":
                row["state"] = "failed" if isinstance(error, Exception) else "stopped"
        words = {}
        if isinstance(error, StageError):
            words["error"] = {"problem": error.problem, "facts": error.facts, "hint": error.hint}
        if self.process:
            self.write(over=True, **words)
            self._end(self.process, PATIENCE)
            self.process = None

    def _start(self) -> Process:
        log = self.place / LOG
        with open(log, "wb") as output:
            process = Process(self.lock, output=output.fileno())
        process.give(
            {"module": self.module, "params": {}, "inputs": {}, "out": str(self.place.absolute()), "device": "cpu", "seed": 0,
             "resumes": False, "upstream": {}, "log": str(log.absolute()), "path": sys.path}
        )  # fmt: skip
        return process

    def _end(self, process: Process, patience: float = float("inf")) -> dict[str, Any] | None:
        """The last event of the process, once it has ended; None where it was killed, as it is after `patience` s."""
        last, until = None, time.monotonic() + patience

        def waits(event: dict[str, Any]) -> None:
            if time.monotonic() > until:
                process.popen.kill()

        for event in events(process.events, process.id, waits):
            last = event
        process.wait()
        process.close()
        return last


@contextmanager
def reporting(session: Session, module: str, wanted: list[str], lock: int) -> Iterator[Report]:
    """The report, made by `module`, of a block that makes results; where the block fails, the page says why."""
    report = Report(session, module, wanted, lock)
    try:
        yield report
    except BaseException as error:
        report.fails(error)
        raise

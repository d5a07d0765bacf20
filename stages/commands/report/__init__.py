"""The report of a pipeline: one page that grows while its stages run, and ends as what they made.

No pipeline names it; a run keeps it going in a process of its own, and writes what it should show to STATE.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Annotated, Any

from pydantic import PlainValidator

from stages import contract
from stages.contract import Job, StageError, StageRecord, whole
from stages.formats.facts import Facts, Number, Whole

STATE, PAGE = ".report.json", "report.html"
NICE = 10  # the stages come first
TICK = 0.5  # s between looks at STATE
EVERY = 5.0  # s, at least, from one page to the next while stages run
HEARTBEAT = 30.0  # s, at most: by it a reader sees that the run is alive
RELOAD = 5  # s after which the browser reads a page that still grows


class Params(contract.Params):
    pass


class Row(Facts):
    """A stage of the pipeline."""

    name: str
    state: str
    """done, running, failed, stopped, waits."""
    folder: Annotated[str, PlainValidator(str)] = ""
    """A path, not always a text: of the result, or of what one that is not done has left so far; '' before it began."""
    seconds: Number = 0.0
    peak_memory_bytes: Whole = 0
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


class Trouble(Facts):
    """The error that ended a run."""

    problem: str
    facts: tuple[str, ...]
    hint: str


class State(Facts):
    """What a run has done so far. `over`: nothing more will come; `now` says how far the running stage is."""

    clip: str
    pipeline: str
    stages: tuple[Row, ...]
    over: bool
    now: str = ""
    error: Trouble | None = None

    @classmethod
    def read(cls, text: str) -> State:
        """The state in a JSON text, in which a path may be no text."""
        return cls.model_validate(json.loads(text), strict=False)


def run(job: Job, params: Params) -> None:
    """Write report.html into the pipeline's folder `job.out`, and again whenever STATE there changes, until it is over.

    A part that cannot be made is named on the page while it grows; StageError where that is so at the end.
    """
    os.nice(NICE)
    known: dict[tuple[str, str], Any] = {}
    seen, written = "", 0.0
    while True:
        text, since = (job.out / STATE).read_text(encoding="utf-8"), time.monotonic() - written
        state = State.read(text)
        if state.over or (text != seen and since > EVERY) or since > HEARTBEAT:
            trouble = write(job.out, state, known)
            seen, written = text, time.monotonic()
        if state.over:
            if trouble:
                raise trouble[0]
            return
        time.sleep(TICK)


def write(folder: Path, state: State, known: dict[tuple[str, str], Any]) -> list[StageError]:
    """Write the page of a state. `known` keeps the parts of results, by stage and folder; returns why parts are missing."""
    from stages.commands.report.parts import parts_of
    from stages.formats import page

    records = {
        row.name: StageRecord(row.seconds, row.peak_memory_bytes, row.notes, row.warnings)
        for row in state.stages
        if row.state == "done"
    }
    done = {row.name: Path(row.folder) for row in state.stages if row.state == "done"}
    begun = {row.name: Path(row.folder) for row in state.stages if row.folder and row.state != "done"}
    parts, trouble = parts_of(done, begun, records, known)
    text = page.fill(
        PAGE,
        title=f"{state.clip}: hugs",
        state=state,
        warnings=[(row.name, text) for row in state.stages for text in row.warnings]
        + [("report", f"{error.problem} {'; '.join(error.facts)}") for error in trouble],
        notes=[(row.name, note) for row in state.stages for note in row.notes],
        reload=0 if state.over else RELOAD,
        page=f"{time.time_ns():x}",
        **parts,
    )
    with whole(folder / PAGE) as new:
        new.write_text(text, encoding="utf-8", errors="replace")
    return trouble

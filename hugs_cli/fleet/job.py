"""One clip of a fleet, in a process of its own: `python -m hugs_cli.fleet.job RUN_FOLDER ROW STEP THREADS`.

The only thing that a fleet places on machines. It takes the clip's lease, runs the stages that are not fresh, and keeps
`rows/ROW.json` in the folder of the fleet's call up to date, from which its page is made. Exit code 0: done.
"""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from hugs_cli.cache import child, engine
from hugs_cli.cache.engine import RunStopped
from hugs_cli.cache.freshness import Reason
from hugs_cli.cache.launcher import Outcome
from hugs_cli.cache.whole import replace
from hugs_cli.cache.workspace import Stamp, read_json
from hugs_cli.console import Console
from hugs_cli.direct import in_words
from hugs_cli.fleet import keep
from hugs_cli.fleet import lease as leases
from hugs_cli.fleet.clips import Row, recorded
from hugs_cli.fleet.lease import Lease
from hugs_cli.fleet.plan import BEFORE, Common, result_of, session_of
from hugs_cli.pipelines import UsageError
from stages.contract import StageError

PLAN, STOP, ROWS, LOGS, SNAKEMAKE_LOG = "plan.json", "stop", "rows", "logs", "snakemake.log"
"""In the folder of one call of a fleet."""
BEAT_EVERY = 1.0  # s
AGAIN = "memory"  # the one kind of failure that a second try, with more memory, may mend
OUT_OF_MEMORY = (" was killed by ", "the machine has no memory left")  # in its problem


class Report:
    """What the fleet is told of this job: the content of its row's file. Written whole, by one thread at a time."""

    def __init__(self, path: Path):
        self.path = path
        self.facts: dict[str, Any] = {"state": "waiting", "pid": os.getpid(), "beat": 0}
        self.changed = threading.Lock()

    def say(self, **facts: Any) -> None:
        """Change what is told, from the next beat on."""
        with self.changed:
            self.facts |= facts

    def write(self, **facts: Any) -> None:
        """Tell it now. A full disk, or one that does not answer, hurts the report, not the result."""
        with self.changed:
            self.facts |= facts | {"beat": self.facts["beat"] + 1}
            with suppress(OSError):
                replace(self.path, json.dumps(self.facts))


class Log(io.RawIOBase):
    """The job's log, stderr. A full disk, or one that does not answer, hurts the log, not the result."""

    def writable(self) -> bool:
        """As all logs."""
        return True

    def write(self, data: Any) -> int:
        """Write at once."""
        with suppress(OSError):
            os.write(2, data)
        return len(data)


class Watch(Console):
    """Prints as `hugs run` does, and reports."""

    def __init__(self, report: Report):
        super().__init__(out=sys.stderr)
        self.report = report

    def waiting(self, holder: str) -> None:
        """Another process has the clip."""
        super().waiting(holder)
        self.report.write(state="waiting", stage=f"for {holder}")

    def started(self, stage: str, reasons: tuple[Reason, ...]) -> None:
        """A stage begins."""
        super().started(stage, reasons)
        self.report.write(state="running", stage=stage, done=0, total=0, left=None)

    def cached(self, stage: str, stamp: Stamp) -> None:
        """A stage is fresh."""
        super().cached(stage, stamp)
        self.report.say(finished=[*self.report.facts.get("finished", []), stage])

    def heard(self, stage: str, event: dict[str, Any]) -> None:
        """A stage reports something."""
        super().heard(stage, event)
        if event.get("event") == "progress":
            left = self.progress.left(self.clock())
            self.report.say(done=event["done"], total=event["total"], left=left)

    def ended(self, stage: str, outcome: Outcome) -> None:
        """A stage's process has ended."""
        super().ended(stage, outcome)
        facts = self.report.facts
        spent = round(facts.get("spent", 0.0) + outcome.seconds, 1)
        finished = [*facts.get("finished", []), *([stage] if outcome.kind == "done" else [])]
        self.report.write(spent=spent, finished=finished, warnings=facts.get("warnings", 0) + len(outcome.warnings))


class Heart(threading.Thread):
    """Beats once a second: writes the report, touches the lease, and stops the run, as Ctrl-C would, when the fleet asks
    for it or is gone, or when the lease is lost."""

    def __init__(self, folder: Path, report: Report, owner: dict[str, Any]):
        super().__init__(daemon=True)
        self.folder, self.report, self.owner = folder, report, owner
        self.lease: Lease | None = None
        self.lost = False
        """Whether another took the lease, which it does where this process was silent for long."""
        self.quiet = threading.Event()

    def run(self) -> None:
        """The thread."""
        touched = 0.0
        while not self.quiet.wait(BEAT_EVERY):
            self.report.write()
            held, lost = self.lease, False
            if held and time.monotonic() - touched > leases.TOUCH_EVERY:
                touched = time.monotonic()
                lost = not held.touch() and self.lease is held  # else it was given back meanwhile
            asked = asked_to_stop(self.folder, self.owner)
            if asked or lost:
                self.lost, self.lease = not asked, None
                os.kill(os.getpid(), signal.SIGTERM)
            if asked:
                return


def asked_to_stop(folder: Path, owner: dict[str, Any]) -> bool:
    """Whether the fleet was stopped, or its process on this machine is gone. `owner` is empty for jobs that may outlive it."""
    return os.path.exists(folder / STOP) or (bool(owner) and leases.is_alive(owner) is False)


def main(folder: Path, row_id: str, step: str, threads: str) -> int:
    """The job."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = threads
    child.prepare()
    sys.stderr = io.TextIOWrapper(Log(), errors="replace", write_through=True)
    plan = read_json(folder / PLAN)
    if row_id not in plan.get("rows", {}):
        print("the call of the fleet that placed this job is over", file=sys.stderr)
        return 1
    listen(stop)
    os.chdir(plan["folder"])
    report = Report(folder / ROWS / f"{row_id}.json")
    before = read_json(report.path)
    if before.get("state") == "failed" and before.get("kind") != AGAIN:
        return 1  # it would fail again
    report.facts |= {name: before[name] for name in ("spent",) if name in before}
    heart = Heart(folder, report, plan["owner"])
    report.write()
    if asked_to_stop(folder, plan["owner"]):
        report.write(state="stopped")
        return 130
    heart.start()
    me = leases.identity()
    while True:
        try:
            row = TypeAdapter(Row).validate_python(plan["rows"][row_id])
            work(row, TypeAdapter(Common).validate_python(plan["common"]), step, report, heart, me)
            return 0
        except RunStopped:
            if heart.lost:
                continue  # another works on the clip now: wait for it
            listen(signal.SIG_IGN)
            heart.quiet.set()
            Console().stopped("", False)
            report.write(state="stopped")
            return 130
        except Exception as error:
            listen(signal.SIG_IGN)
            heart.quiet.set()
            report.write(state="failed", **told(error))
            return 1


def work(row: Row, common: Common, step: str, report: Report, heart: Heart, me: dict[str, Any]) -> None:
    """Bring one clip, or the stages of a step, up to date."""
    watch = Watch(report)
    session = session_of(row, common)
    session.check_sources()
    session.workspace.create()
    every = wanted = list(session.pipeline.stages)
    device = common.device
    if step == BEFORE:  # where there may be no GPU
        wanted, device = [name for name in session.pipeline.upstream(["train"]) if name != "train"], "cpu"
    later = [name for name in every if name not in wanted]
    session.workspace.leased = True
    with leases.lease(session.workspace.root / leases.NAME, watch.waiting, me) as held:
        heart.lease, heart.lost = held, False
        try:
            if (other := recorded(session.workspace.root)) not in (None, os.path.abspath(row.video)):
                hint = "call the fleet again: it gives this clip a folder of its own"
                raise UsageError(f"{session.workspace.root} now holds the results of {other}", hint)
            result = keep.record(session, common.keep).get("result")
            if result is None:
                ran = engine.run(session, wanted, frozenset(), device, watch, report=True, later=later)
                stamps, folders = ({one.stage: one.stamp for one in ran}, {one.stage: one.folder for one in ran})
                result = result_of(stamps, folders, session.workspace.links)
            if common.keep and "freed" not in result and step != BEFORE:
                with session.workspace.lock(watch.waiting):
                    result = keep.let_go(session, common.keep, result)
        finally:
            heart.lease = None
    heart.quiet.set()
    if step == BEFORE:
        report.write(state="before", stage="")
    else:
        report.write(state="done", stage="", finished=every, result=result)


def told(error: Exception) -> dict[str, Any]:
    """How a row's file tells of a failure, and the words for the log."""
    said = in_words(error, "hugs")
    Console().error(said)
    bug = bool(getattr(said, "traceback", "")) and not isinstance(error, StageError)
    kind = "bug" if bug else AGAIN if any(words in said.problem for words in OUT_OF_MEMORY) else "error"
    return {"kind": kind, "problem": said.problem, "hint": said.hint, "facts": list(said.facts)}


def listen(handler: Any) -> None:
    """What Ctrl-C and SIGTERM do while no stage runs."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def stop(signum: int, frame: Any) -> None:
    """End the run."""
    raise RunStopped


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), *sys.argv[2:]))

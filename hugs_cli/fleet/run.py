"""A fleet from its plan to its page."""

from __future__ import annotations

import os
import re
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from hugs_cli.cache.engine import RunStopped
from hugs_cli.cache.workspace import write_json
from hugs_cli.console import QUIET_EVERY, Console
from hugs_cli.fleet import board, lease
from hugs_cli.fleet.board import OPEN, Board
from hugs_cli.fleet.job import LOGS, PLAN, ROWS
from hugs_cli.fleet.plan import Common, Planned
from hugs_cli.fleet.runner import Loop, Order, Runner, Snakemake
from hugs_cli.pipelines import UsageError
from hugs_cli.words import duration, size
from stages.contract import StageError

LOOK_EVERY, PAGE_EVERY = 0.2, 2.0  # s
PAGE_SHARE = 20  # a page is written again after at least so many times what writing it took
CALL = re.compile(r"[0-9a-f]{12}")  # names of the folders of calls
STOPPING = 90.0  # s until jobs that were asked to stop are ended


@dataclass(frozen=True)
class Fleet:
    """One call of `hugs fleet`: its plan and how it is run."""

    name: str
    common: Common
    planned: list[Planned]
    split: bool
    jobs: int
    profile: str | None

    @property
    def folder(self) -> Path:
        """The folder of all calls of this fleet."""
        return (self.common.work / ".fleet" / self.name).absolute()

    def run(self, console: Console) -> tuple[list[dict[str, Any]], dict[str, Any]]:
        """Do what is left; returns the rows and totals. Raises RunStopped, with the page written, if it is stopped."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with lease.lease(self.folder / lease.NAME, self.refuse) as held:
            room = self.folder / held.me["token"][:12]  # of its own, so that jobs of an earlier call cannot meddle
            todo = [one for one in self.planned if one.state == "todo"]
            show = Board(room, self.common.work, self.planned)
            press = Press(self, show, console)
            try:
                if todo:
                    press.print()
                    self.lay_out(room, held.me, todo)
                    order = Order(room, todo, self.split, self.jobs, self.profile)
                    self.drive(order, press, held)
            except BaseException:
                if lease.holds(held.path, held.me):  # else the page is another's
                    press.print(over=True)
                raise
            return press.print(over=True)

    def refuse(self, holder: str) -> None:
        """UsageError where another fleet of this name is at work; nothing where its process is gone."""
        if lease.lives(self.folder / lease.NAME):
            hint = "wait until it is done, or give this one a `--name` of its own: they share the work"
            raise UsageError(f"a fleet {self.name} is at work in this folder: {holder}", hint)

    def lay_out(self, room: Path, me: dict[str, Any], todo: list[Planned]) -> None:
        """Write what the jobs of this call read, and take away the folders of earlier calls."""
        for old in self.folder.iterdir():
            if CALL.fullmatch(old.name):
                shutil.rmtree(old, ignore_errors=True)  # a job of an earlier call may still write there
        for folder in (ROWS, LOGS):
            (room / folder).mkdir(parents=True)
        plan = {
            "owner": {} if self.profile else me,
            "folder": os.getcwd(),
            "common": self.common,
            "rows": {one.row.id: one.row for one in todo},
        }
        write_json(room / PLAN, to_jsonable_python(plan))

    def drive(self, order: Order, press: Press, held: lease.Lease) -> None:
        """Place the jobs, wait until all have ended, and keep the page up to date; on Ctrl-C let them stop."""
        jobs: Runner = Snakemake(order) if self.profile or self.jobs > 1 else Loop(order, press.show.kind)
        try:
            try:
                self.wait(jobs, press, held)
            except RunStopped:
                press.console.say("stopping: stages write what they need to continue later (Ctrl-C again: at once)")
                jobs.stop()
                self.wait(jobs, press, held, STOPPING)
                raise
            if isinstance(jobs, Snakemake):
                jobs.check()
        except BaseException:
            jobs.kill()
            raise

    def wait(self, jobs: Runner, press: Press, held: lease.Lease, longest: float = float("inf")) -> None:
        """Until no job is left, or for so many seconds. StageError if another call took this fleet's place, which it does
        where this one was silent for long."""
        end, touched = time.monotonic() + longest, 0.0
        while jobs.going() and time.monotonic() < end:
            if time.monotonic() - touched > lease.TOUCH_EVERY:
                touched = time.monotonic()
                if not held.touch():
                    hint = "call it again when no other is at work: what is finished is kept"
                    facts = ["another call has taken its place, or its folder was removed"]
                    raise StageError(f"the fleet {self.name} has lost its lease {held.path}", hint, facts)
            press.print_if_due()
            time.sleep(LOOK_EVERY)


class Press:
    """Prints the page while the fleet runs, and a line now and then."""

    def __init__(self, fleet: Fleet, show: Board, console: Console):
        self.fleet, self.show, self.console = fleet, show, console
        self.due = 0.0
        self.unwritten = ""
        """Why the page could not be written the last time."""
        self.said: dict[str, str] = {}
        self.last_line = time.monotonic()

    def print(self, over: bool = False) -> tuple[list[dict[str, Any]], dict[str, Any]]:
        """Write page and table; returns the rows and totals."""
        began = time.monotonic()
        self.show.look(over)
        rows = self.show.rows(over)
        total = board.totals(rows, self.fleet.jobs)
        why = ""
        try:
            board.write(self.fleet.common.work, self.fleet.name, rows, total, live=not over)
        except (OSError, StageError) as error:  # a full disk: the clips go on, and the page comes when there is room
            why = getattr(error, "strerror", None) or str(error)
        if why and (over or why != self.unwritten):
            self.console.say(f"the page cannot be written: {why}")
        self.unwritten = why
        now = time.monotonic()
        self.due = now + max(PAGE_EVERY, PAGE_SHARE * (now - began))
        self.speak(rows, total, over)
        return rows, total

    def print_if_due(self) -> None:
        """Write the page if it is time."""
        if time.monotonic() > self.due:
            self.print()

    def speak(self, rows: list[dict[str, Any]], total: dict[str, Any], over: bool) -> None:
        """A line for each clip that has ended; and what runs: always on a terminal, elsewhere now and then."""
        for one, row in zip(self.show.planned, rows, strict=True):
            before, state = self.said.get(one.row.id, one.state), row["state"]
            self.said[one.row.id] = state
            if state != before and state not in (*OPEN, "todo"):
                self.last_line = time.monotonic()
                text = row["problem"] or (duration(row["seconds"]) if row["seconds"] else "")
                text += f", {size(row['freed'])} freed" if row["freed"] else ""
                self.console.say(f"  {state:<9}{row['folder']}  {row['pipeline']}  {text}".rstrip())
        if not over and (self.console.live or time.monotonic() - self.last_line > QUIET_EVERY):
            self.last_line = time.monotonic()
            busy = [now(row) for row in rows if row["state"] in ("running", "waiting")]
            self.console.rows([*busy, f"  {counts(total)}"])


def now(row: dict[str, Any]) -> str:
    """What a running clip is at: 'running  dance  default  train 43 %  about 2m 10s left'."""
    percent = "" if row["percent"] is None or row["state"] == "waiting" else f" {row['percent']} %"
    left = "" if row["seconds_left"] is None else f"  about {duration(row['seconds_left'])} left"
    silent = "" if row["silent"] is None else f"  no sign of life for {duration(row['silent'])}"
    return f"  {row['state']:<9}{row['folder']}  {row['pipeline']}  {row['stage']}{percent}{left}{silent}".rstrip()


def counts(total: dict[str, Any]) -> str:
    """'3 done, 1 running, 8 to do; about 12m left'."""
    words = {"todo": "to do"}
    states = ", ".join(f"{number} {words.get(state, state)}" for state, number in total["states"].items())
    left = total["seconds_left"]
    return states + (f"; about {duration(left)} left" if left else "")

"""All output: progress to stderr, results to stdout. Only on a terminal a row moves."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, TextIO

from hugs_cli import times
from hugs_cli.cache.freshness import CodeChanged, InputChanged, ParamChanged, Reason, SeedChanged, Upstream, Verdict
from hugs_cli.cache.launcher import Outcome
from hugs_cli.cache.workspace import Stamp
from hugs_cli.countdown import Again, Countdown, Progress
from hugs_cli.direct import StageFailed
from hugs_cli.words import ago, count, duration, number, plain
from stages.contract import StageError

if TYPE_CHECKING:
    from hugs_cli.doctor import Finding

STATE_WIDTH, TIME_WIDTH = 12, 15
ON_ONE_LINE = 4  # reasons
QUIET_EVERY = 60.0  # s between lines of a long stage where no row can move
ENDINGS = {"done": "done", "stopped": "stopped"}  # every other ending reads 'failed'


def reasons_text(reasons: tuple[Reason, ...]) -> str:
    """Reasons of a re-run on one line, the first of many; `hugs why` shows them all."""
    texts = list(map(str, reasons))
    if len(texts) > ON_ONE_LINE:
        texts[ON_ONE_LINE - 1 :] = [f"{len(texts) - ON_ONE_LINE + 1} more"]
    return ", ".join(texts)


class Console:
    """Prints the output of one command: lines, progress, and the time that is left."""

    def __init__(
        self,
        out: TextIO | None = None,
        err: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        name_width: int = 9,
    ):
        self.out, self.err, self.clock = out or sys.stdout, err or sys.stderr, clock
        self.live = self.err.isatty() and os.environ.get("TERM") != "dumb"
        self.color = self.live and not os.environ.get("NO_COLOR")
        self.name_width = name_width
        self.progress = Progress(0.0)
        self.countdown: Countdown | None = None
        self.only_new = False
        """Whether cached stages have no rows: they are the same as in the run before this one."""
        self.opening: list[Callable[[bool], None]] = []
        """What prints the first lines of a run; it is given whether it is sure that stages will run."""
        self.reasons = ""
        self.shown_notes: list[str] = []
        self.last_line = 0.0
        self.above = 0
        """Moving rows above the one in which the cursor stands."""

    # results

    def result(self, text: str = "") -> None:
        """A line of a command's result, or several."""
        print("\n".join(map(plain, text.split("\n"))), file=self.out, flush=True)

    def error(self, error: StageError) -> None:
        """The problem, facts, a blank line and the hint; for a bug the traceback first."""
        self.clear()
        if isinstance(error, StageFailed):
            for line in error.traceback.splitlines():
                self.say(line)
        self.say(error.problem, before=f"{self.paint('error:', 31)} ")
        for fact in error.facts:
            self.say(f"  {fact}")
        if error.hint:
            self.say(error.hint, before=f"\n{self.paint('hint:', 36)} ")

    def stopped(self, stage: str, continues: bool) -> None:
        """The run was asked to stop and did."""
        where = f" in {stage}; the next run {'continues it' if continues else 'begins it again'}" if stage else ""
        self.say(f"stopped{where}; finished stages are kept")

    # progress

    def say(self, text: str, before: str = "") -> None:
        """One line to stderr, after the moving row is wiped. Only `before` may hold control characters."""
        self.clear()
        print(f"{before}{plain(text)}", file=self.err, flush=True)

    def begin(self, sure: bool) -> None:
        """Print the first lines of a run, once. `sure`: its stages take what they are given."""
        while self.opening:
            self.opening.pop(0)(sure)

    def header(self, clip: str, facts: str, pipeline: str, folder: str, device: str, why: str) -> None:
        """What a run is of, and where it computes."""
        self.say(f"{clip}  {facts}".rstrip() + f"   pipeline {pipeline}   {folder}   {device}: {why}")

    def expect(self, stages: Iterable[tuple[str, times.Guess]], again: Again) -> None:
        """Say how long stages to run will take, given in order, and count them down from now on, see `Countdown`."""
        known = list(stages)
        self.countdown = Countdown(known, again)
        if known:
            self.say(f"this run takes {times.said(times.total(guess for _, guess in known))}")

    def row(self, stage: str, state: str, seconds: str, text: str) -> str:
        """Stage, state, time, text in columns."""
        return plain(f"  {stage:<{self.name_width}}{state:<{STATE_WIDTH}}{seconds:<{TIME_WIDTH}}{text}".rstrip())

    def below(self, text: str) -> None:
        """A line under the row of a stage."""
        self.say(f"  {'':<{self.name_width}}{text}")

    def waiting(self, holder: str) -> None:
        """Another run holds this clip."""
        self.say(f"waiting: {holder} is working on this clip; this run goes on when it is done (Ctrl-C gives up)")

    def cached(self, stage: str, stamp: Stamp) -> None:
        """A stage whose result is fresh."""
        if self.only_new:
            return
        self.say(self.row(stage, "cached", "", f"saved {duration(stamp.seconds):>9}"))
        for warning in stamp.warnings:
            self.warning(warning)

    def started(self, stage: str, reasons: tuple[Reason, ...]) -> None:
        """A stage's process begins."""
        self.progress = Progress(self.clock())
        if self.countdown:
            self.countdown.started(stage)
        self.reasons, self.shown_notes = reasons_text(reasons), []
        self.last_line = self.clock()
        self.draw(stage)

    def heard(self, stage: str, event: dict[str, Any]) -> None:
        """A stage reports something, or ({}) time has passed."""
        kind = event.get("event")
        if kind == "progress":
            self.progress.take(event, self.clock())
        if event.get("at_once"):
            self.shown_notes.append(event["text"])
            self.say(f"  {stage:<{self.name_width}}{event['text']}")
        if kind in (None, "progress"):
            self.draw(stage)

    def listens(self, name: str) -> Callable[[dict[str, Any]], None]:
        """What hears the job of a command, which has a moving row and leaves none."""
        self.started(name, ())

        def heard(event: dict[str, Any]) -> None:
            if event["event"] in ("note", "warning"):
                self.say(f"{'warning: ' if event['event'] == 'warning' else ''}{event['text']}")
            else:
                self.heard(name, event)

        return heard

    def ended(self, stage: str, outcome: Outcome) -> None:
        """A stage's process has ended: print its row, its notes and its warnings."""
        if self.countdown:
            self.countdown.ended(stage, outcome.seconds, outcome.compiling)
        state = ENDINGS.get(outcome.kind, "failed")
        text = self.reasons
        notes = [note for note in outcome.notes if note not in self.shown_notes]
        short = "; ".join([text, *notes]) if outcome.kind == "done" else text
        together = len(self.row(stage, state, "", short)) <= 118
        self.say(self.row(stage, state, duration(outcome.seconds), short if together else text))
        for note in [] if together else notes:
            self.below(note)
        for warning in outcome.warnings:
            self.warning(warning)

    def warning(self, text: str) -> None:
        """A warning about a result, under its row."""
        self.say(text, before=f"  {'':<{self.name_width}}{self.paint('warning:', 33)} ")

    def draw(self, stage: str) -> None:
        """Show how far the running stage is: redraw the row on a terminal, elsewhere a line every minute."""
        now, progress = self.clock(), self.progress
        if not self.live and now - self.last_line < QUIET_EVERY:
            return
        state, text = "running", self.reasons
        elapsed = duration(now - progress.started)
        if progress.event:
            done, total = progress.event["done"], progress.event["total"]
            state = f"{done}/{total}  {100 * done // max(total, 1)} %"
            text = "  ".join(number(name, value) for name, value in progress.event["numbers"].items())
        text = f"{self.time_left(stage)}  {text}".strip()
        if self.live:
            line = f"  {stage:<{self.name_width}}{state:<{STATE_WIDTH}}  {elapsed:<7}  {plain(text)}".rstrip()
            self.err.write(f"\r\x1b[2K{line[: shutil.get_terminal_size().columns - 1]}")
            self.err.flush()
        else:
            self.last_line = now
            self.say(f"  {stage:<{self.name_width}}{state}  {elapsed}  {text}".rstrip())

    def rows(self, lines: list[str]) -> None:
        """Several moving rows on a terminal, in place of those before; elsewhere they are said."""
        if not self.live:
            for line in lines:
                self.say(line)
            return
        self.clear()
        size = shutil.get_terminal_size()
        shown = (
            lines
            if len(lines) < size.lines
            else [*lines[: size.lines - 2], f"  and {len(lines) - size.lines + 2} more"]
        )
        self.err.write("\n".join(plain(line)[: size.columns - 1] for line in shown))
        self.err.flush()
        self.above = max(len(shown) - 1, 0)

    def time_left(self, stage: str) -> str:
        """How long the running stage, and the run, will still take; '' where nothing is known of it."""
        now = self.clock()
        own, whole = self.progress.left(now), self.countdown.left(stage, self.progress, now) if self.countdown else None
        return "" if own is whole is None else f"about {left_text(own, whole)}"

    def clear(self) -> None:
        """Wipe the moving rows."""
        if self.live:
            self.err.write(f"\x1b[{self.above}A\r\x1b[J" if self.above else "\r\x1b[2K")
            self.above = 0

    def paint(self, text: str, color: int) -> str:
        """The text in a colour, on a terminal that shows colours."""
        return f"\x1b[1;{color}m{text}\x1b[0m" if self.color else text

    # status and why

    def verdicts(self, verdicts: dict[str, Verdict]) -> None:
        """A line for each stage: fresh or not, its age, its time, why it would run."""
        self.name_width = max([self.name_width, *(len(name) + 1 for name in verdicts)])
        for name, verdict in verdicts.items():
            stamp = verdict.stamp or verdict.last
            took = duration(stamp.seconds) if stamp else ""
            text = f"made {ago(stamp.made)}" if stamp and verdict.fresh else reasons_text(verdict.reasons)
            self.result(self.row(name, verdict.state, took, text))
            for warning in stamp.warnings if stamp and verdict.fresh else []:
                self.result(f"  {'':<{self.name_width}}warning: {plain(warning)}")

    def why(self, verdict: Verdict, now: dict[str, str]) -> None:
        """Everything about one stage: what its last result was made of, and what differs. `now`: versions by name."""
        stamp = verdict.stamp or verdict.last
        if stamp is None:
            self.result(f"{verdict.stage} would run: {reasons_text(verdict.reasons)}.")
            return
        last = f"{stamp.key[:8]}, {ago(stamp.made)}, {duration(stamp.seconds)}"
        if verdict.fresh:
            self.result(f"{verdict.stage} is fresh ({last}).")
        else:
            may = "may run" if verdict.state == "waits" else "would run"
            self.result(f"{verdict.stage} {may}. Its last result ({last}) was made with")
        for reason in verdict.reasons:
            self.result(f"  {why_line(reason)}")
        for entry in stamp.accepted:
            self.result(f"Accepted {ago(entry['when'])}: {', '.join(entry['changes'])}")
        self.result(same_text(stamp, verdict.reasons))
        machine = stamp.machine
        with_ = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
        self.result(f"Made on {machine['host']}, {machine['device']}, {machine['processors']} processors, {with_}")
        other = [
            f"{name} {old} -> {now[name]}"
            for name, old in machine["versions"].items()
            if now.get(name, old).partition("+")[0] != old.partition("+")[0]
        ]
        if other:
            self.result(f"Since then (makes nothing stale): {', '.join(other)}")

    def findings(self, findings: list[Finding]) -> None:
        """A line for each finding of doctor, and its hint below."""
        for finding in findings:
            state = "ok" if finding.ok else "none" if finding.optional else "missing"
            self.result(f"  {finding.name:<32}{state:<9}{finding.text}".rstrip())
            if finding.hint and not finding.ok:
                self.result(f"  {'':<32}hint: {finding.hint}")


def left_text(own: float | None, whole: float | None) -> str:
    """'1m 10s left, 12m 4s in all': of a stage and of the run, or of one of them."""
    if own is None or whole is None:
        return f"{duration(own or whole or 0)} left{' in all' if own is None else ''}"
    return f"{duration(own)} left{f', {duration(whole)} in all' if whole > own else ''}"


def why_line(reason: Reason) -> str:
    """A reason in columns: kind, what, how."""
    match reason:
        case CodeChanged(module, how):
            return f"{'code':<9}{module:<22} {how} since".rstrip()
        case ParamChanged(name, old, new):
            return f"{'params':<9}{name:<22} {old} -> {new}"
        case InputChanged(name, how, decided):
            return f"{'inputs':<9}{name:<22} {how} since{': ' if decided else ''}{', '.join(decided)}"
        case SeedChanged(old, new):
            return f"{'seed':<9}{'':<22} {old} -> {new}"
        case Upstream(stages):
            return f"{'after':<9}{', '.join(stages):<22} would run first"
    return str(reason)


def same_text(stamp: Stamp, reasons: tuple[Reason, ...]) -> str:
    """The inputs that are the same by name, and how many settings and modules are."""
    changed = {getattr(reason, "name", getattr(reason, "module", None)) for reason in reasons}
    inputs = [name for name, content in stamp.inputs.items() if name not in changed and content]
    settings = sum(name not in changed for name in stamp.params)
    modules = sum(name not in changed for name in stamp.code)
    return f"Same as before: {', '.join([*inputs, count(settings, 'setting'), count(modules, 'module')])}"

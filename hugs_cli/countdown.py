"""How long a stage, and the whole run, will still take, from what is heard of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

RECENT = 1 / 3  # of the time so far: what the speed is read from, so that a machine that becomes slow is noticed
FINE = 1 / 200  # of the time so far: marks lie no closer
SOON = 2.0  # s, before which no speed is read
LATE, LEAST = 0.15, 1.0  # of the time since something was heard, and s: what ought to be over takes that long at least
SLOW = 0.8  # exponent of how much slower than expected it went, for what is still to come: a part of that is chance
SURE = 0.3  # of all that is expected, after which that counts whole
MOST = 5.0  # times as slow as expected, at most


@dataclass
class Marks:
    """Times, and how much was done by then."""

    seen: list[tuple[float, float]] = field(default_factory=list)

    def add(self, now: float, done: float) -> None:
        """So much is done now."""
        if len(self.seen) > 2 and now - self.seen[-2][0] < FINE * (now - self.seen[0][0]):
            self.seen.pop()
        self.seen.append((now, done))

    def speed(self) -> float | None:
        """Done in a second lately; None before SOON, and where nothing was done."""
        if not self.seen or (end := self.seen[-1][0]) - self.seen[0][0] < SOON:
            return None
        since, done = end - max(SOON, RECENT * (end - self.seen[0][0])), self.seen[-1][1]
        began, before = next((mark for mark in reversed(self.seen[:-1]) if mark[0] <= since), self.seen[0])
        return (done - before) / (end - began) if done > before else None


@dataclass
class Progress:
    """The running stage: when it began, and its last progress event, heard `at` a time."""

    started: float
    event: dict[str, Any] = field(default_factory=dict)
    at: float = 0.0
    marks: Marks = field(default_factory=Marks)

    def take(self, event: dict[str, Any], now: float) -> None:
        """Keep a progress event. A new total or a step back begins a new part, which has its own speed."""
        if self.event and (event["total"] != self.event["total"] or event["done"] < self.event["done"]):
            self.marks = Marks()
        self.marks.add(now, event["done"])
        self.event, self.at = event, now

    def left(self, now: float) -> float | None:
        """Seconds until it ends: the stage's own number, or from its speed; None in the first SOON s. Never 0."""
        left, speed = self.event.get("left"), self.marks.speed()
        if left is None and speed is not None:
            left = (self.event["total"] - self.event["done"]) / speed
        return None if left is None else remaining(left, now - self.at)


def remaining(left: float, since: float) -> float:
    """What remains of `left` seconds `since` so many seconds."""
    return max(left - since, LEAST + LATE * since)


class Countdown:
    """Counts down what is to run: stages in order, each with the seconds that are expected."""

    def __init__(self, stages: Iterable[tuple[str, float]], now: float):
        self.stages, self.over, self.marks = list(stages), 0.0, Marks()
        self.marks.add(now, 0.0)

    def started(self, stage: str) -> None:
        """A stage begins: those expected before it are not run after all."""
        self.stages = self.stages[next((i for i, (name, _) in enumerate(self.stages) if name == stage), 0) :]

    def ended(self, stage: str, now: float) -> None:
        """A stage that had begun has ended."""
        if self.stages and self.stages[0][0] == stage:
            self.over += self.stages.pop(0)[1]
            self.marks.add(now, self.over)

    def left(self, stage: str, progress: Progress, now: float) -> float | None:
        """Seconds until the last stage ends, while `stage` runs; None where nothing was expected."""
        if not self.stages or self.stages[0][0] != stage:
            return None
        expected = self.stages[0][1]
        own, event = progress.left(now), progress.event
        if event:
            self.marks.add(progress.at, self.over + expected * event["done"] / max(event["total"], 1))
        rest = sum(seconds for _, seconds in self.stages)
        passed = self.marks.seen[-1][1] / max(self.over + rest, LEAST)
        slow = min(max(1 / (self.marks.speed() or 1.0), 1 / MOST), MOST) ** (SLOW * min(1.0, passed / SURE))
        if own is None:
            own = remaining(slow * expected, now - progress.started)
        return own + slow * (rest - expected)

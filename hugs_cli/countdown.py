"""How long a stage, and the whole run, will still take, from what is heard of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

from hugs_cli.times import Guess

RECENT = 1 / 3  # of the time so far: what the speed is read from, so that a machine that becomes slow is noticed
FINE = 1 / 200  # of the time so far: marks lie no closer
SOON = 2.0  # s, before which no speed is read
LATE, LEAST = 0.15, 1.0  # of the time since something was heard, and s: what ought to be over takes that long at least
SURE = 0.3  # of the guessed whole: steps counted for less time weigh less, since steps differ in length
GUESSED = 0.1  # of the guessed whole: that stages take as long as guessed weighs as much as a stage of so much


@dataclass
class Marks:
    """Times, and how much was done by then."""

    seen: list[tuple[float, float]] = field(default_factory=list)

    def add(self, now: float, done: float) -> None:
        """So much is done now."""
        if len(self.seen) > 2 and now - self.seen[-2][0] < FINE * (now - self.seen[0][0]):
            self.seen.pop()
        self.seen.append((now, done))

    def since(self) -> tuple[float, float] | None:
        """The mark from which on the speed is read; None before SOON."""
        if not self.seen or (end := self.seen[-1][0]) - self.seen[0][0] < SOON:
            return None
        since = end - max(SOON, RECENT * (end - self.seen[0][0]))
        return next((mark for mark in reversed(self.seen[:-1]) if mark[0] <= since), self.seen[0])

    def speed(self) -> float | None:
        """Done in a second lately; None before SOON, and where nothing was done."""
        if (mark := self.since()) is None:
            return None
        (began, before), (end, done) = mark, self.seen[-1]
        return (done - before) / (end - began) if done > before else None


@dataclass
class Progress:
    """The running stage: when it began, and its last progress event, heard `at` a time."""

    started: float
    event: dict[str, Any] = field(default_factory=dict)
    at: float = 0.0
    marks: Marks = field(default_factory=Marks)
    stepped: float | None = None
    """When its first step was done, and so its kernels were compiled."""

    @property
    def done(self) -> float:
        """The share of its steps that is done."""
        return self.event["done"] / max(self.event["total"], 1) if self.event else 0.0

    def take(self, event: dict[str, Any], now: float) -> None:
        """Keep a progress event. A new total or a step back begins a new part, which has its own speed."""
        if self.event and (event["total"] != self.event["total"] or event["done"] < self.event["done"]):
            self.marks = Marks()
        self.marks.add(now, event["done"])
        self.event, self.at = event, now
        if self.stepped is None and event["done"]:
            self.stepped = now

    def left(self, now: float) -> float | None:
        """Seconds until it ends: the stage's own number, or from its speed; None in the first SOON s. Never 0."""
        left, speed = self.event.get("left"), self.marks.speed()
        if left is None and speed is not None:
            left = (self.event["total"] - self.event["done"]) / speed
        return None if left is None else remaining(left, now - self.at)


def remaining(left: float, since: float) -> float:
    """What remains of `left` seconds `since` so many seconds."""
    return max(left - since, LEAST + LATE * since)


Again = Callable[[list[str]], Mapping[str, Guess]]
"""Given the stage that has ended and those still to do: other guesses, where more is known of the clip now."""


class Countdown:
    """Counts down what is to run: stages in order, each with its guess, and corrects these by how long the first ones take, and by
    what is guessed `again` when one has ended.
    """

    def __init__(self, stages: Iterable[tuple[str, Guess]], again: Again = lambda todo: {}):
        self.stages, self.again = list(stages), again
        self.over: list[tuple[float, float]] = []
        """Of each stage that has ended: how many times as long as guessed it took, and the guess in s, both without compiling."""

    def started(self, stage: str) -> None:
        """A stage begins: those expected before it are not run after all."""
        self.stages = self.stages[next((i for i, (name, _) in enumerate(self.stages) if name == stage), 0) :]

    def ended(self, stage: str, seconds: float, compiling: float) -> None:
        """A stage that had begun has ended, after `seconds`, in some of which it was `compiling`."""
        if self.stages and self.stages[0][0] == stage:
            known = self.again([name for name, _ in self.stages])
            self.stages = [(name, known.get(name, guess)) for name, guess in self.stages]
            guessed = self.stages.pop(0)[1].running
            self.over.append(((seconds - compiling) / guessed, guessed))

    def left(self, stage: str, progress: Progress, now: float) -> float | None:
        """Seconds until the last stage ends, while `stage` runs; None where nothing was expected."""
        if not self.stages or self.stages[0][0] != stage:
            return None
        (_, guess), *rest = self.stages
        sure = self._sure(progress)
        slow = self._slow(guess, sure, progress, now)
        if guess.compiling and progress.stepped is not None:
            expected = remaining(slow * guess.running, now - progress.stepped)
        else:
            expected = remaining(slow * guess.seconds, now - progress.started)
        own = progress.left(now)
        if own is None:
            own = expected
        else:
            weight = sure if "left" in progress.event else sure * progress.done
            own = weight * own + (1 - weight) * expected
        return own + slow * sum(one.seconds for _, one in rest)

    @property
    def _whole(self) -> float:
        """Guessed seconds of all stages, without compiling."""
        return sum(guessed for _, guessed in self.over) + sum(one.running for _, one in self.stages)

    def _sure(self, progress: Progress) -> float:
        """How much the running stage's own numbers show, 0 to 1: less after a short time."""
        seen = progress.marks.seen
        return min(1.0, (seen[-1][0] - seen[0][0]) / (SURE * self._whole)) if seen else 0.0

    def _slow(self, guess: Guess, sure: float, progress: Progress, now: float) -> float:
        """How many times as long as guessed stages take: the median of those that have ended, of the running one, by its own
        number, and of 1. So one stage that is slow for reasons of its own does not slow the others.
        """
        own, seen = progress.left(now), [(1.0, GUESSED * self._whole), *self.over]
        if own is not None:
            began = progress.stepped if guess.compiling and progress.stepped is not None else progress.started
            seen.append(((now - began + own) / guess.running, sure * progress.done * guess.running))
        return weighted_median(seen)


def weighted_median(values: Iterable[tuple[float, float]]) -> float:
    """The value, of values and their weights, which has half of the weight with smaller ones."""
    ordered = sorted(values)
    below = list(accumulate(weight for _, weight in ordered))
    return next(value for (value, _), so_far in zip(ordered, below, strict=True) if so_far >= below[-1] / 2)

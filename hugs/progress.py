"""How far a call is, for whoever asks: what a command prints, as values."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hugs_cli.cache.freshness import Reason
from hugs_cli.cache.launcher import Outcome
from hugs_cli.cache.workspace import Stamp
from hugs_cli.console import ENDINGS, Console


@dataclass(frozen=True)
class Progress:
    """How far `run`, `train`, `export`, `animate` or `compose` is: what their `progress` is called with.

    A stage that runs calls a few times a second.

        hugs.run("dance.mp4", progress=lambda now: print(now.stage, now.left))
    """

    stage: str = ""
    """The stage that this is about; '' where a sentence is about all."""
    state: str = ""
    """'cached', 'running', 'done', 'failed' or 'stopped'; '' with a sentence alone."""
    done: int = 0
    """Steps of the stage that are finished."""
    total: int = 0
    """Of so many; 0 where the stage does not count."""
    left: float | None = None
    """Seconds to go, of all stages; None while that is unknown."""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """What is worth seeing of the stage, by name: `psnr` in dB, `gaussians`."""
    said: tuple[str, ...] = ()
    """Sentences: notes and warnings of a stage that has ended, and what else a command would print."""


Hear = Callable[[Progress], object]


class Listener(Console):
    """The console of a call from Python: all goes to `hear`, nothing is printed."""

    def __init__(self, hear: Hear):
        super().__init__(io.StringIO(), io.StringIO())
        self.hear = hear

    def say(self, text: str, before: str = "") -> None:
        """A sentence."""
        self.hear(Progress(said=(f"{before}{text}".strip(),)))

    def cached(self, stage: str, stamp: Stamp) -> None:
        """A stage whose result is fresh, if that is new."""
        if not self.only_new:
            self.hear(Progress(stage, "cached", said=tuple(stamp.warnings)))

    def draw(self, stage: str) -> None:
        """How far the running stage is."""
        now, event = self.clock(), self.progress.event
        left = self.countdown.left(stage, self.progress, now) if self.countdown else self.progress.left(now)
        done, total = event.get("done", 0), event.get("total", 0)
        self.hear(Progress(stage, "running", done, total, left, event.get("numbers", {})))

    def ended(self, stage: str, outcome: Outcome) -> None:
        """A stage has ended."""
        if self.countdown:
            self.countdown.ended(stage, self.clock())
        self.hear(Progress(stage, ENDINGS.get(outcome.kind, "failed"), said=(*outcome.notes, *outcome.warnings)))

    def started(self, stage: str, reasons: tuple[Reason, ...]) -> None:
        """A stage begins, for `reasons`, which are sentences."""
        super().started(stage, reasons)
        if self.reasons:
            self.say(f"{stage}: {self.reasons}")


def console_for(progress: Hear | None) -> Console:
    """Where a call's lines go: to `progress`, or, without it, to stderr as the command's do."""
    return Listener(progress) if progress else Console()

"""The progress of a call from Python: the values that a command prints."""

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
    """The progress of `run`, `train`, `export`, `animate` or `compose`: the argument of their callback `progress`.

    While a stage runs, the callback is called a few times a second.

        hugs.run("dance.mp4", progress=lambda now: print(now.stage, now.left))
    """

    stage: str = ""
    """The name of the stage; '' for a sentence about the whole call."""
    state: str = ""
    """'cached', 'running', 'done', 'failed' or 'stopped'; '' for a sentence alone."""
    done: int = 0
    """Finished steps of the stage."""
    total: int = 0
    """All steps of the stage; 0 if the stage does not count steps."""
    left: float | None = None
    """Seconds until all stages are done; None if unknown."""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """Current numbers of the stage by name, such as `psnr` in dB or `gaussians`."""
    said: tuple[str, ...] = ()
    """Sentences that a command would print, such as notes and warnings of a finished stage."""


Hear = Callable[[Progress], object]


class Listener(Console):
    """The console of a call from Python: it calls `hear` and prints nothing."""

    def __init__(self, hear: Hear):
        super().__init__(io.StringIO(), io.StringIO())
        self.hear = hear

    def say(self, text: str, before: str = "") -> None:
        """Pass a sentence on."""
        self.hear(Progress(said=(f"{before}{text}".strip(),)))

    def cached(self, stage: str, stamp: Stamp) -> None:
        """A stage whose result is fresh, if that is new."""
        if not self.only_new:
            self.hear(Progress(stage, "cached", said=tuple(stamp.warnings)))

    def draw(self, stage: str) -> None:
        """Pass on the progress of the running stage."""
        now, event = self.clock(), self.progress.event
        left = self.countdown.left(stage, self.progress, now) if self.countdown else self.progress.left(now)
        done, total = event.get("done", 0), event.get("total", 0)
        self.hear(Progress(stage, "running", done, total, left, event.get("numbers", {})))

    def ended(self, stage: str, outcome: Outcome) -> None:
        """Pass on that a stage has ended."""
        if self.countdown:
            self.countdown.ended(stage, outcome.seconds, outcome.compiling)
        self.hear(Progress(stage, ENDINGS.get(outcome.kind, "failed"), said=(*outcome.notes, *outcome.warnings)))

    def started(self, stage: str, reasons: tuple[Reason, ...]) -> None:
        """Pass on why a stage starts."""
        super().started(stage, reasons)
        if self.reasons:
            self.say(f"{stage}: {self.reasons}")


def console_for(progress: Hear | None) -> Console:
    """The console that calls `progress`; without `progress` one that prints to stderr, as commands do."""
    return Listener(progress) if progress else Console()

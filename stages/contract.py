"""What a stage is: its settings, its job, and how it says that it cannot do its work."""

from __future__ import annotations

import resource
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Params(BaseModel):
    """Settings of one stage: frozen, unknown keys refused, docstrings under the fields shown by `hugs stages`."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


def speed_only(default: Any, **limits: Any) -> Any:
    """A setting that changes speed, never the result: it stays out of the stage's key."""
    return Field(default, json_schema_extra={"speed_only": True}, **limits)


class StageError(Exception):
    """A stage cannot do its work.

    `problem` is one line: what is wrong, lower case, no full stop. `facts` are lines with numbers and names.
    `hint` names the command or the change that helps.
    """

    def __init__(self, problem: str, hint: str = "", facts: tuple[str, ...] | list[str] = ()):
        super().__init__(problem)
        self.problem = problem
        self.facts = tuple(facts)
        self.hint = hint


@dataclass
class Job:
    """One run of one stage: where to write, what to run on, and how to talk to the person watching.

    `out` is an empty folder, or, when the stage module says `RESUMES = True`, what a killed run of the same key left.
    """

    out: Path
    device: str = "cpu"
    seed: int = 0
    emit: Callable[[dict[str, Any]], None] = lambda event: None
    _stop: bool = field(default=False, repr=False)

    def progress(self, done: int, total: int, left: float | None = None, **numbers: Any) -> None:
        """Report that `done` of `total` steps are finished, with named numbers worth seeing.

        `left` seconds to go, from a stage that knows better than by its speed so far.
        """
        known = {} if left is None else {"left": left}
        self.emit({"event": "progress", "done": done, "total": total, "numbers": numbers} | known)

    def note(self, text: str, at_once: bool = False) -> None:
        """Say one fact about the result; it is shown beside the stage when it ends, or at once, and kept in its stamp."""
        self.emit({"event": "note", "text": text} | ({"at_once": True} if at_once else {}))

    def warn(self, text: str) -> None:
        """Say what a user should know before trusting the result; shown, kept in the stamp and put in the report."""
        self.emit({"event": "warning", "text": text})

    @property
    def stop_asked(self) -> bool:
        """True after Ctrl-C or SIGTERM: write a checkpoint and raise `Stopped`."""
        return self._stop

    def listen_for_stop(self) -> None:
        """Turn SIGINT and SIGTERM into `stop_asked` for stages that can checkpoint."""

        def ask(signum: int, frame: Any) -> None:
            self._stop = True

        signal.signal(signal.SIGINT, ask)
        signal.signal(signal.SIGTERM, ask)


class Stopped(Exception):
    """A stage was asked to stop and left what it needs to go on from in `job.out`."""


def peak_memory() -> int:
    """The most bytes of memory that this process has held so far."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most  # Linux counts kilobytes

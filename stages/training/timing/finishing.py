"""What follows the last step of a training, part by part, and about how long it takes."""

from __future__ import annotations

import time

from stages.contract import Job

GAINS, HIDDEN, SHAPING, SETTLING, WRITING = (
    "measuring effects",
    "filling what is hidden",
    "finishing",
    "settling",
    "writing",
)
STEPS = {HIDDEN: 28.0, SHAPING: 34.0, SETTLING: 165.0, WRITING: 4.0}
"""Part -> full, grown steps that take as long, of each person or once. The kitchen clip, 2 cores, November 2026."""
GAIN = 20.0
"""The same for measuring what one effect is worth."""


def finishing_parts(people: int, effects: int = 0, settling: float = 1.0) -> list[tuple[str, float]]:
    """The parts in order and the full, grown steps of each; `effects` are measured, and settling takes a share of its steps."""
    each = [(SHAPING, STEPS[SHAPING]), (SETTLING, settling * STEPS[SETTLING])]
    return [
        *([(GAINS, GAIN * effects)] if effects else []),
        (HIDDEN, STEPS[HIDDEN]),
        *(people * each),
        (WRITING, STEPS[WRITING]),
    ]


class Finishing:
    """Tells the job which part begins and how long all will take, given its parts, the training's steps and seconds a step.

    Where parts took longer than that, so do those to come.
    """

    def __init__(self, job: Job, parts: list[tuple[str, float]], steps: int, step: float):
        self.note, self.warn, self.progress = job.note, job.warn, job.progress
        self.parts, self.steps, self.step, self.at = parts, steps, step, 0
        self.began = time.perf_counter()

    def begins(self, name: str) -> None:
        """The next part of this name begins; those before it are over, also where they were left out."""
        self.at = next((i for i in range(self.at, len(self.parts)) if self.parts[i][0] == name), self.at)
        over, rest = (sum(steps for _, steps in some) for some in (self.parts[: self.at], self.parts[self.at :]))
        spent = time.perf_counter() - self.began
        pace = spent / over if over and spent > over * self.step else self.step
        self.at += 1
        self.progress(round(self.steps + over), round(self.steps + over + rest), pace * rest, now=name)

"""How many steps fit into a time: a few real ones are timed first, and the steps taken correct the estimate."""

from __future__ import annotations

import copy
import math
import time
from statistics import median
from typing import Any

from stages.training.step.fit import Fit
from stages.training.step.schedule import LATE, SCENE_GROWTH, SETTLE, Progress
from stages.training.timing.calibration import ENOUGH, FEWEST, PAUSE

WARM_UP = 2  # steps that no clock sees
TIMED = 4  # least steps of one timing, rounded up to whole periods of decoding and LPIPS
LONG = 24  # steps; an LPIPS that comes more rarely is not waited for
TIMINGS = 3  # of each of a Pace's four numbers before sizes are chosen; their median ignores one disturbance
OFTEN = 1 / 60  # of the time: how often the steps are fitted into what is left of it
PARTS = 200  # of an integral; no clock is finer
REHEARSED = 0.02  # of the time; once a rehearsal took that long, what is still to be timed is timed once


class Pace:
    """Seconds a step takes, by the share of the schedule that is behind it.

    `half` and `full` are seconds a step at each resolution, before and after the share `half_until`, with as many
    Gaussians as at the start and as at the end; in between they grow evenly. `slow` is the factor by
    which real steps were slower. `networks`: seconds a step that are not in these, and the share after which they are saved.
    """

    def __init__(
        self,
        half: tuple[float, float],
        full: tuple[float, float],
        half_until: float,
        slow: float = 1.0,
        networks: tuple[float, float] = (0.0, 0.0),
    ):
        self.half, self.full, self.half_until, self.slow, self.networks = half, full, half_until, slow, networks

    def mean(self, start: float, end: float = 1.0) -> float:
        """Mean seconds a step between two shares of the schedule."""
        shares = [start + (end - start) * (i + 0.5) / PARTS for i in range(PARTS)]
        return self.slow * sum(map(self._at, shares)) / PARTS

    @property
    def last(self) -> float:
        """Seconds a full, grown step takes: as long as drawing what was trained."""
        return self.slow * self.full[1]

    def _at(self, done: float) -> float:
        few, many = self.half if done < self.half_until else self.full
        more, until = self.networks
        grown = min(max((done - SCENE_GROWTH[0]) / (SETTLE - SCENE_GROWTH[0]), 0.0), 1.0)
        return few + grown * (many - few) + (more if done < until else 0.0)

    def steps(self, seconds: float, done: float = 0.0) -> int:
        """How many steps from `done` on take `seconds`; at least one."""
        return max(1, int(seconds / self.mean(done)))

    def learn(self, seconds: float, steps: int, start: float, end: float) -> None:
        """Correct the pace by the seconds of `steps` steps between two shares of the schedule."""
        if steps > 0 and end > start:
            self.slow *= seconds / (steps * self.mean(start, end))


class Deadline:
    """The time that a training may take. Its steps are fitted into it before the first one, and again on the way.

    It ends `seconds` after `began` (of time.perf_counter) and leaves over the time of `reserve` full, grown steps, or of
    only `least` where it hurries. `pauses` accuracy measurements are still to come, then `extra` more, which a
    hurried training skips.
    """

    def __init__(self, seconds: float, reserve: float, least: float, began: float, pauses: int, extra: int = 0):
        self.seconds, self.reserve, self.least, self.began = seconds, reserve, min(least, reserve), began
        self.pauses, self.extra, self.hurried = pauses, extra, False
        self.pace = Pace((0.0, 0.0), (0.0, 0.0), 0.0)
        self.pause = self.paused = 0.0
        self.leg = 0.0, 0, 0.0

    @property
    def spent(self) -> float:
        """Seconds gone."""
        return time.perf_counter() - self.began

    @property
    def left(self) -> float:
        """Seconds left for steps."""
        return self.seconds - self.spent - self.reserve * self.pace.last - (self.pauses + self.extra) * self.pause

    def to_go(self, progress: Progress) -> float:
        """Seconds until the last step, pauses included; of a training that is late, as long as its steps take."""
        steps = (progress.total - progress.step) * self.pace.mean(progress.done)
        return max(steps, self.left) + max(0, self.pauses) * self.pause

    def hurry(self) -> None:
        """Leave over only what the least that comes after training takes."""
        self.reserve, self.extra, self.hurried = self.least, 0, True

    def fitting(self, done: float) -> int:
        """How many steps fit into what is left from the share `done` of the schedule on."""
        return self.pace.steps(self.left, done)

    def start(self, fit: Fit, timings: int = TIMINGS) -> int:
        """Time a few steps of a training that has not begun, see `rehearse`; returns how many fit into the time."""
        self.pace = rehearse(fit, timings, REHEARSED * self.seconds)
        self.pause = PAUSE * self.pace.last
        self.leg = self.spent, fit.progress.step, fit.progress.done
        return self.fitting(0.0)

    def add_pause(self, pause: float) -> None:
        """Accuracy was measured, which took `pause` seconds."""
        self.pause, self.pauses, self.paused = pause, self.pauses - 1, self.paused + pause

    def mark(self, fit: Fit) -> None:
        """If the last time was long ago, correct the pace by the steps since then and fit the remaining steps in."""
        spent, step, done = self.leg
        stepping = self.spent - spent - self.paused
        if stepping < OFTEN * self.seconds:
            return
        now = fit.progress
        self.leg, self.paused = (self.spent, now.step, now.done), 0.0
        self.pace.learn(stepping, now.step - step, done, now.done)
        if now.step + self.fitting(now.done) < ENOUGH and not self.hurried:
            self.hurry()
        now.retime(max(self.fitting(now.done), FEWEST - now.step))

    def state(self) -> list[Any]:
        """For a checkpoint."""
        pace = self.pace
        own = [self.spent, self.pauses, self.pause, self.hurried]
        return [*own, pace.half, pace.full, pace.half_until, pace.slow]

    def load(self, state: list[Any], fit: Fit) -> None:
        """Go on from `state()`."""
        spent, self.pauses, self.pause, hurried, *pace = state
        if hurried:
            self.hurry()
        self.began -= spent
        self.pace = Pace(*pace)
        self.leg = self.spent, fit.progress.step, fit.progress.done


def rehearse(fit: Fit, timings: int = TIMINGS, seconds: float = math.inf) -> Pace:
    """Time real steps of a training that has not begun, with few and many Gaussians; leaves it as it was, bit for bit.

    The median of `timings` of each kind counts, of one where `seconds` are over.
    """
    until = time.perf_counter() + seconds
    before, half_until = copy.deepcopy(fit.state()), fit.half_until
    fit.half_until = late = min(half_until, LATE)  # a full step is timed even where training has none: films are full
    few = _timed(fit, 0.0, timings, until), _timed(fit, late, timings, until)
    fit.densifier.fill_up(fit.adam)
    many = _timed(fit, 0.0, timings, until), _timed(fit, late, timings, until)
    fit.load(before)
    fit.half_until, fit.clock.seconds = half_until, {}
    return Pace((few[0], many[0]), (few[1], many[1]), half_until)


def _timed(fit: Fit, done: float, timings: int, until: float) -> float:
    """Seconds a step, the median of `timings`, with the schedule frozen at its share `done`; one timing after `until`."""
    fit.progress.freeze(done)
    for _ in range(WARM_UP):
        fit.advance()
    views = fit.params.views_per_decode
    took: list[float] = []
    often = math.lcm(views, fit.params.perceptual_every or 1)
    often = often if often <= LONG else views
    count = often * math.ceil(TIMED / often)
    while not took or (len(took) < timings and time.perf_counter() < until):
        began = time.perf_counter()
        for _ in range(count):
            fit.advance()
        took.append((time.perf_counter() - began) / count)
    return median(took)

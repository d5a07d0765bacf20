"""A training from a clip to its result. No files but a checkpoint's, where one is given."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import torch

from stages.avatar.measures.poses import farthest
from stages.avatar.splats.neighbours import spread_evenly
from stages.contract import Job, StageError, Stopped, peak_memory
from stages.training.beginning.start import Task, build
from stages.training.checkpoint import Checkpoint
from stages.training.finishing.settle import SHARE, STEPS
from stages.training.results import Result, effect_facts, result_of
from stages.training.step.fit import Fit
from stages.training.timing.accuracy import heldout_accuracy
from stages.training.timing.budget import Choice, fit_into_time
from stages.training.timing.calibration import PAUSE
from stages.training.timing.deadline import Deadline, Pace
from stages.training.timing.effect_gains import PAUSES, effect_gains, effects_of
from stages.training.timing.finishing import GAINS, WRITING, Finishing, finishing_parts
from stages.training.timing.window import Window

MEASURED = 6  # held-out frames on the accuracy curve
LOOK = "a wrong mask or body fit is the usual cause: look at what `masks` and `smpl` said; else try `--seed 1`"
COLUMNS = ("step", "seconds", "psnr", "ssim", "psnr_person", "ssim_person", "human", "scene", "memory_bytes")
"""Of the curve."""
SAVED = ("curve", "seconds", "parts", "choice", "deadline")
"""What a checkpoint holds besides the state of the training's `Fit`."""
HALF, FULL = (0.25, 0.6), (0.3, 1.0)
NETWORKS, NETWORKS_ALONE = 0.33, 0.95
"""Of the time of a full, grown step without networks: steps of each resolution before and after growth, see `Pace`, and the
networks, with a scene and without. Six clips of the table through `default`, 2 idle cores of Zen 4, November 2026."""
LEG = 5.0  # s of steps, whose pace is that of the steps to come


class Breakdown(Exception):
    """A step broke a training; from `state` it breaks again. `frame` is the name of the frame that it learned from."""

    def __init__(self, fit: Fit, task: Task, error: Exception):
        super().__init__(str(error))
        self.state, self.left_out = fit.before or fit.state(), fit.guard.left_out
        self.params, self.decisions = task.params, task.decisions
        self.step, self.frame = self.state["progress"]["step"], task.clips[0].names[fit.frame]


@dataclass
class Training:
    """A training under way: its `curve` so far, and the seconds of its steps, pauses left out."""

    task: Task
    fit: Fit
    choice: Choice = field(default_factory=Choice)
    deadline: Deadline | None = None
    curve: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    leg: tuple[float, int, float] | None = None
    """Seconds, step and share of the schedule at which the pace was last looked at."""

    @cached_property
    def pace(self) -> Pace:
        """The pace of a training without a deadline: of a usual shape, and as fast as its last steps."""
        fit = self.fit
        networks = (NETWORKS if fit.scene else NETWORKS_ALONE) if fit.people and fit.params.triplane else 0.0
        return Pace(HALF, FULL, fit.half_until, networks=(networks, fit.params.networks_until))

    @property
    def weighs_effects(self) -> bool:
        """Whether it is measured in the end what effects gain."""
        return self.fit.params.effect_gains and not (self.deadline and self.deadline.hurried)

    @property
    def after(self) -> list[tuple[str, float]]:
        """See `finishing_parts`."""
        effects = len(effects_of(self.fit)) if self.weighs_effects else 0
        settling = min(1.0, SHARE * self.fit.progress.total / STEPS)
        return finishing_parts(len(self.fit.people), effects, settling)

    def mark(self, seconds: float) -> None:
        """Correct the pace by the steps since it was last looked at; `seconds` of all steps so far."""
        now = self.fit.progress
        before, step, done = self.leg or (seconds, now.step, now.done)
        if self.leg and seconds - before > LEG:
            self.pace.learn(seconds - before, now.step - step, done, now.done)
        if self.leg is None or seconds - before > LEG:
            self.leg = seconds, now.step, now.done

    def to_go(self) -> float | None:
        """Seconds until the result, with what follows the last step; None until the pace is known."""
        now, after = self.fit.progress, sum(steps for _, steps in self.after)
        if self.deadline:
            return self.deadline.to_go(now) + after * self.deadline.pace.last
        if self.pace.slow == 1.0:
            return None
        pauses = PAUSE * max(0, self.task.params.curve_points - len(self.curve))
        return (now.total - now.step) * self.pace.mean(now.done) + (pauses + after) * self.pace.last

    @cached_property
    def heldout(self) -> list[int]:
        """The held-out frames that show the person, at most MEASURED of them."""
        clip = self.task.clips[0]
        return spread_evenly([i for i in range(len(clip.names)) if clip.heldout[i] and clip.shows_person(i)], MEASURED)

    @cached_property
    def far(self) -> list[int]:
        """The held-out frames whose poses are farthest from those of training, at most MEASURED of them."""
        clip = self.task.clips[0]
        shown = [i for i in range(len(clip.names)) if clip.heldout[i] and clip.shows_person(i)]
        return spread_evenly(farthest(clip.body.body_pose, shown, clip.training), MEASURED)

    def state(self) -> dict[str, Any]:
        """For a checkpoint, see SAVED."""
        return {
            "curve": self.curve,
            "seconds": self.seconds,
            "parts": self.fit.clock.seconds,
            "choice": asdict(self.choice),
            "deadline": self.deadline and self.deadline.state(),
        }


def run(
    task: Task,
    job: Job,
    checkpoint: Checkpoint | None = None,
    checkpoint_seconds: float = 60,
    began: float | None = None,
    window: Window | None = None,
) -> Result:
    """Train, from the start or from where a checkpoint left it; `window` shows how far it is.

    The time of `task.params.seconds` counts from `began` (of time.perf_counter; None: now). Raises Breakdown, Stopped
    when asked to stop, StageError where clip or time is not enough.
    """
    training = begin(task, job, checkpoint, time.perf_counter() if began is None else began)
    learn(training, job, checkpoint, checkpoint_seconds, window)
    return finish(training, job)


def begin(task: Task, job: Job, checkpoint: Checkpoint | None, began: float) -> Training:
    """The training at its first step, or where a checkpoint left it."""
    params, deadline = task.params, None
    if params.seconds:
        deadline = Deadline(params.seconds, params.reserve, params.reserve_least, began, params.curve_points)
    saved = checkpoint.load(SAVED) if checkpoint else None
    if saved:
        task = task.chosen(**saved["choice"])
    fit = build(task, job.note, job.warn)
    if deadline and (effects := effects_of(fit)):
        deadline.extra = PAUSES * len(effects) + 1
    if checkpoint and saved:
        return _resume(task, fit, deadline, checkpoint, saved, job)
    choice = Choice()
    if deadline:

        def rebuilt(choice: Choice) -> Fit:
            return build(task.chosen(choice.settings, choice.left_out), job.note, job.warn)

        def note(text: str) -> None:
            job.note(text, at_once=True)

        try:
            fit, choice = fit_into_time(fit, params, deadline, rebuilt, note)
        except (FloatingPointError, ValueError) as error:
            raise StageError("training broke down in its first steps", LOOK, [str(error)]) from error
    return Training(task.chosen(choice.settings, choice.left_out), fit, choice, deadline)


def _resume(
    task: Task, fit: Fit, deadline: Deadline | None, checkpoint: Checkpoint, saved: dict[str, Any], job: Job
) -> Training:
    checkpoint.resume(fit, saved["fit"])
    job.note(f"goes on after step {fit.progress.step}")
    if saved["threads"] != (now := torch.get_num_threads()):
        job.warn(f"{saved['threads']} threads before, {now} now: sums differ in their last digits")
    fit.clock.seconds = dict(saved["parts"])
    if deadline:
        deadline.load(saved["deadline"], fit)
    return Training(task, fit, Choice(**saved["choice"]), deadline, saved["curve"], saved["seconds"])


def learn(
    training: Training,
    job: Job,
    checkpoint: Checkpoint | None = None,
    checkpoint_seconds: float = 60,
    window: Window | None = None,
) -> None:
    """Take all steps, measure accuracy on the way, and save a checkpoint every so often and when asked to stop."""
    fit, curve, deadline = training.fit, training.curve, training.deadline
    progress, params = fit.progress, training.task.params
    sizes = " and ".join(f"{count:,} of the {name}" for name, count in fit.sizes().items() if count)
    job.note(f"{len(fit.train)} training frames; starts with {sizes}")
    mark = saved = time.perf_counter()
    while progress.step < progress.total:
        try:
            numbers = fit.advance()
        except (FloatingPointError, ValueError) as error:
            raise Breakdown(fit, training.task, error) from error
        shown: dict[str, float | str] = {}
        due = progress.share * params.curve_points >= len(curve) + 1
        if progress.step == progress.total or due:
            paused = time.perf_counter()
            training.seconds += paused - mark
            curve.append(
                {"step": progress.step, "seconds": round(training.seconds, 3)} | _measured(fit, training.heldout)
            )
            mark = time.perf_counter()
            if deadline:
                deadline.add_pause(mark - paused)
            shown = {"psnr": curve[-1]["psnr"]}
            if window:
                window.curve(curve)
        elif progress.step % 25 == 0:
            shown = {"loss": sum(numbers.values())}
        if deadline is None and shown:
            training.mark(training.seconds + time.perf_counter() - mark)
        elif deadline and progress.step % 25 == 0 and progress.step < progress.total:
            deadline.mark(fit)
        if shown:
            total = progress.total + round(sum(steps for _, steps in training.after))
            job.progress(progress.step, total, training.to_go(), **shown, gaussians=sum(fit.sizes().values()))
            if window:
                window.look(fit, training.heldout)
        if checkpoint and (job.stop_asked or time.perf_counter() - saved > checkpoint_seconds):
            saved = time.perf_counter()
            training.seconds, mark = training.seconds + saved - mark, saved
            checkpoint.save(fit, training.state())
        if job.stop_asked:
            raise Stopped(f"stopped after step {progress.step} of {progress.total}; the next run goes on from there")


def finish(training: Training, job: Job) -> Result:
    """The result of a training that has taken all its steps."""
    fit, curve, deadline = training.fit, training.curve, training.deadline
    effects: dict[str, dict[str, Any]] = {}
    pace, steps = deadline.pace if deadline else training.pace, fit.progress.step
    step = pace.last if deadline or pace.slow != 1.0 else training.seconds / max(steps, 1)
    say = Finishing(job, training.after, steps, step)
    if training.weighs_effects:
        say.begins(GAINS)
        try:
            found = effect_gains(fit, training.heldout, training.far)
            effects = effect_facts(found, curve[-1]["seconds"], job.note, job.warn)
        except (FloatingPointError, ValueError) as error:  # a timed step failed: the training is over, and is kept
            job.warn(f"the gains of the effects could not be measured: {error}")
    result = result_of(fit, training.task.clips, curve, effects, say)
    say.begins(WRITING)
    result.facts["effects_left_out"] = list(training.choice.left_out)
    if deadline:
        result.facts["last_step_seconds"] = round(deadline.pace.last, 4)
    return result


def _measured(fit: Fit, frames: list[int]) -> dict[str, Any]:
    """A row of the curve, without its step and seconds."""
    found = heldout_accuracy(fit.cast(), fit.seen(), frames)
    numbers = {key: "" if value is None else round(value, 4) for key, value in found.items()}
    return {key: numbers[key] for key in COLUMNS[2:6]} | fit.sizes() | {"memory_bytes": peak_memory()}

"""The countdown against simulated runs: quiet, slower from the middle on, guessed wrong, with kernels to compile; never 0 with much
to do."""

import pytest

from hugs_cli.countdown import Countdown, Marks, Progress, remaining, weighted_median
from hugs_cli.times import Guess

STAGES = {"frames": 4.0, "masks": 41.0, "smpl": 75.0, "train": 610.0, "render": 60.0, "evaluate": 90.0, "notes": 3.0}
TICK, SOON = 1.0, 2.0
SILENT = ("notes",)  # it reports nothing
PREVIEW = {
    "frames": 1.5,
    "masks": 7.5,
    "sfm": 3.0,
    "smpl": 11.5,
    "survey": 6.0,
    "train": 21.0,
    "export": 2.0,
    "render": 4.0,
    "evaluate": 3.0,
}
COMPILING = 34.0
UNEVEN = {
    "survey": (0.15, *[0.21] * 5, 0.3, 0.7, 0.77, 0.77, 0.89, 0.89, 0.89),
    "smpl": (*[0.1] * 42, *[0.2] * 13, *[0.23 + 0.017 * i for i in range(45)]),
}
"""Shares of its time after which a stage of `preview` has done its steps."""


def simulated(slow_from: float = 1.0, guessed: float = 1.0, knows: bool = False, end: float = 0.0):
    """Time and what the countdown shows then, for each tick of a run: twice as slow from a share of its work on, its stages
    `guessed` times as long as they are. `knows`: training says how long it takes; `end`: share of a stage after 100 %."""
    whole, now, done, shown = sum(STAGES.values()), 0.0, 0.0, []
    countdown = Countdown([(name, Guess(guessed * seconds, 1.0)) for name, seconds in STAGES.items()])
    for stage, length in STAGES.items():
        countdown.started(stage)
        progress, spent, step = Progress(now), 0.0, 0
        while spent < length:
            speed = 0.5 if done > slow_from * whole else 1.0
            spent, done, now = spent + speed * TICK, done + speed * TICK, now + TICK
            reached = min(50, int(50 * spent / (length * (1 - end))))
            if stage not in SILENT and reached > step:
                step = reached
                left = {"left": (length - spent) / speed} if knows and stage == "train" else {}
                progress.take({"done": step, "total": 50} | left, now)
            shown.append((now, countdown.left(stage, progress, now)))
        countdown.ended(stage, now - progress.started, 0.0)
    return shown, now


def preview(slow: float = 1.0, compiling: float = 0.0, compiled_in: float = 1.0, cached: str = "", masks: float = 1.0):
    """The same of a first run of `preview`, on a machine `slow` times as slow as guessed. Kernels are guessed to compile in
    so many seconds, and do so in `compiled_in` times that; one stage that is expected is `cached`, and `masks` take so many times
    as long."""
    guesses = {name: Guess(seconds, 2.0) for name, seconds in PREVIEW.items()}
    guesses["train"] = Guess(PREVIEW["train"] + compiling, 2.0, compiling)
    countdown, now, shown = Countdown(guesses.items()), 0.0, []
    for stage, seconds in (PREVIEW | {"masks": masks * PREVIEW["masks"]}).items():
        if stage == cached:
            continue
        before = slow * compiling * compiled_in if stage == "train" else 0.0
        length, tick, progress, spent, step = slow * seconds, slow * 0.25, Progress(now), 0.0, 0
        steps = UNEVEN.get(stage) or [i / 50 for i in range(1, 51)]
        countdown.started(stage)
        while spent < before + length:
            spent, now = spent + tick, now + tick
            reached = sum(share * length <= spent - before for share in steps)
            if reached > step:
                step = reached
                knows = {"left": length - spent + before} if stage == "train" and spent - before > 5 else {}
                progress.take({"done": step, "total": len(steps)} | knows, now)
            shown.append((now, countdown.left(stage, progress, now)))
        countdown.ended(stage, now - progress.started, before)
    return shown, now


@pytest.mark.parametrize("cached", ["", "smpl"])
@pytest.mark.parametrize("compiling", [0.0, COMPILING])
@pytest.mark.parametrize("slow", [0.5, 1.0, 2.0])
def test_half_of_a_first_run_on_any_machine_it_is_within_15_percent(slow, compiling, cached):
    """Stages that have ended show how fast the machine is; uneven steps of the running one do not."""
    shown, end = preview(slow, compiling, cached=cached)
    for half in (0.45, 0.5, 0.55):
        left = next(left for now, left in shown if now >= half * end)
        assert left == pytest.approx((1 - half) * end, rel=0.15)


@pytest.mark.parametrize("compiled_in", [0.2, 3.0])
def test_compiling_that_took_another_time_than_guessed_is_over_with_the_first_step(compiled_in):
    shown, end = preview(1.0, COMPILING, compiled_in)
    begins = sum(PREVIEW[name] for name in ("frames", "masks", "sfm", "smpl", "survey")) + compiled_in * COMPILING
    for now, left in shown:
        if begins + 1 <= now < begins + PREVIEW["train"]:
            assert left == pytest.approx(end - now, rel=0.15)


@pytest.mark.parametrize("knows", [False, True])
@pytest.mark.parametrize(
    ("slow_from", "guessed"), [(1.0, 1.0), (0.5, 1.0), (0.3, 1.0), (1.0, 2.0), (1.0, 0.5), (0.5, 1.4), (0.5, 0.7)]
)
def test_half_way_it_is_within_15_percent_and_never_0_with_2_seconds_to_go(slow_from, guessed, knows):
    shown, end = simulated(slow_from, guessed, knows)
    left = next(left for now, left in shown if now >= end / 2)
    assert left == pytest.approx(end / 2, rel=0.15)
    assert min(left for now, left in shown if end - now > SOON) > 1


def after(seconds: float, compiling: float = 0.0, **guesses: Guess) -> tuple[Countdown, Progress]:
    """The countdown when the first of two or three stages took so many seconds, and the second begins at 0 s."""
    countdown, (first, second, *_) = Countdown(guesses.items()), guesses
    countdown.started(first)
    countdown.ended(first, seconds, compiling)
    countdown.started(second)
    return countdown, Progress(0.0)


def test_one_long_step_of_a_short_stage_is_no_slow_machine():
    countdown, progress = after(30.0, one=Guess(30.0, 1.0), survey=Guess(6.0, 1.0), train=Guess(60.0, 1.0))
    progress.take({"done": 1, "total": 10}, 1.0)
    progress.take({"done": 2, "total": 10}, 4.0)
    assert countdown.left("survey", progress, 4.0) == pytest.approx(62, rel=0.1)


@pytest.mark.parametrize("slow", [1.0, 2.0])
def test_one_stage_that_is_slow_for_reasons_of_its_own_slows_no_other(slow):
    """As `masks` of courtyard, 2.9 times as long as usual (docs/lab/2026-11/speed.md)."""
    shown, end = preview(slow, masks=2.9)
    left = next(left for now, left in shown if now >= 0.5 * end)
    assert left == pytest.approx(0.5 * end, rel=0.15)


def test_what_a_stage_shows_of_the_clip_changes_its_own_guess_and_those_to_come():
    first, asked = {"masks": 30.0, "sfm": 20.0, "train": 270.0, "render": 15.0}, []

    def again(todo):
        asked.append(todo)
        return {"sfm": Guess(2.0, 1.0), "train": Guess(90.0, 1.0)} if todo[0] == "sfm" else {}

    countdown = Countdown(((name, Guess(seconds, 1.0)) for name, seconds in first.items()), again)
    for name, seconds in (("masks", 60.0), ("sfm", 4.0)):
        countdown.started(name)
        countdown.ended(name, seconds, 0.0)
    countdown.started("train")
    assert countdown.left("train", Progress(0.0), 0.0) == pytest.approx(2 * (90 + 15)), "the machine is half as fast"
    assert asked == [["masks", "sfm", "train", "render"], ["sfm", "train", "render"]]


def test_compiling_is_no_part_of_how_long_the_running_stage_takes():
    countdown, progress = after(1.0, one=Guess(1.0, 1.0), train=Guess(54.0, 1.0, 34.0), render=Guess(30.0, 1.0))
    for step in range(1, 17):
        progress.take({"done": step, "total": 20, "left": 20.0 - step}, 100.0 + step)
    assert countdown.left("train", progress, 116.0) == pytest.approx(4 + 30, rel=0.1)


def test_a_short_stage_and_compiling_show_nothing_of_how_fast_the_machine_is():
    countdown, progress = after(10.0, frames=Guess(2.0, 1.0), train=Guess(98.0, 1.0))
    assert countdown.left("train", progress, 0.0) == pytest.approx(98)
    countdown, progress = after(75.0, 55.0, train=Guess(54.0, 1.0, 34.0), render=Guess(30.0, 1.0))
    assert countdown.left("render", progress, 0.0) == pytest.approx(30)


def test_what_a_stage_does_after_its_last_step_is_not_0_seconds():
    shown, end = simulated(end=0.3)
    assert min(left for now, left in shown if end - now > SOON) > 1


def test_stages_that_turn_out_to_be_there_already_are_no_longer_expected():
    seconds = [("masks", 40.0), ("train", 600.0), ("notes", 3.0), ("train", 500.0)]
    countdown = Countdown((name, Guess(one, 1.0)) for name, one in seconds)
    countdown.started("train")
    assert countdown.left("train", Progress(0.0), 0.0) == pytest.approx(600 + 3 + 500)
    countdown.ended("train", 600.0, 0.0)
    countdown.started("train")
    assert (
        countdown.left("train", Progress(600.0), 600.0) < 1000 and countdown.left("other", Progress(0.0), 0.0) is None
    )


def test_speed_is_that_of_the_last_third():
    marks = Marks()
    assert marks.speed() is None
    for now in range(100):
        marks.add(now, 2 * now if now < 50 else 100 + (now - 50) / 2)
    assert marks.speed() == pytest.approx(0.5)
    marks.add(99, 10)
    assert marks.speed() is None, "a step back has no speed"
    for now in range(100, 20_000):
        marks.add(now, now)
    assert marks.speed() == pytest.approx(1) and len(marks.seen) < 2000


def test_a_weighted_median_has_half_of_the_weight_below_it():
    assert weighted_median([(3.0, 1.0), (1.0, 2.0), (2.0, 2.0)]) == 2 and weighted_median([(5.0, 0.1)]) == 5
    assert weighted_median([(1.0, 1.0), (9.0, 1.1)]) == 9 and weighted_median([(1.0, 1.1), (9.0, 1.0)]) == 1


def test_time_that_should_be_over_is_a_part_of_what_it_took():
    assert remaining(100, 40) == 60 and remaining(10, 100) == pytest.approx(16) and remaining(0, 0) == 1

"""The countdown against simulated runs: quiet, slower from the middle on, guessed wrong; never 0 with much to do."""

import pytest

from hugs_cli.countdown import Countdown, Marks, Progress, remaining

STAGES = {"frames": 4.0, "masks": 41.0, "smpl": 75.0, "train": 610.0, "render": 60.0, "evaluate": 90.0, "notes": 3.0}
TICK, SOON = 1.0, 2.0
SILENT = ("notes",)  # it reports nothing


def simulated(slow_from: float = 1.0, guessed: float = 1.0, knows: bool = False, end: float = 0.0):
    """Time and what the countdown shows then, for each tick of a run: twice as slow from a share of its work on, its stages
    `guessed` times as long as they are. `knows`: training says how long it takes; `end`: share of a stage after 100 %."""
    whole, now, done, shown = sum(STAGES.values()), 0.0, 0.0, []
    countdown = Countdown([(name, guessed * seconds) for name, seconds in STAGES.items()], now)
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
        countdown.ended(stage, now)
    return shown, now


@pytest.mark.parametrize("knows", [False, True])
@pytest.mark.parametrize(
    ("slow_from", "guessed"), [(1.0, 1.0), (0.5, 1.0), (0.3, 1.0), (1.0, 2.0), (1.0, 0.5), (0.5, 1.4), (0.5, 0.7)]
)
def test_half_way_it_is_within_15_percent_and_never_0_with_2_seconds_to_go(slow_from, guessed, knows):
    shown, end = simulated(slow_from, guessed, knows)
    left = next(left for now, left in shown if now >= end / 2)
    assert left == pytest.approx(end / 2, rel=0.15)
    assert min(left for now, left in shown if end - now > SOON) > 1


def test_what_a_stage_does_after_its_last_step_is_not_0_seconds():
    shown, end = simulated(end=0.3)
    assert min(left for now, left in shown if end - now > SOON) > 1


def test_stages_that_turn_out_to_be_there_already_are_no_longer_expected():
    countdown = Countdown([("masks", 40.0), ("train", 600.0), ("notes", 3.0), ("train", 500.0)], 0.0)
    countdown.started("train")
    assert countdown.left("train", Progress(0.0), 0.0) == pytest.approx(600 + 3 + 500)
    countdown.ended("train", 600.0)
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


def test_time_that_should_be_over_is_a_part_of_what_it_took():
    assert remaining(100, 40) == 60 and remaining(10, 100) == pytest.approx(16) and remaining(0, 0) == 1

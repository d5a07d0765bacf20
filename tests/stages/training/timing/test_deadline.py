"""Training within a time: pace, rehearsal, and the end on time on any machine."""

from types import SimpleNamespace

import pytest

from stages.training.run import Training
from stages.training.settings import Params
from stages.training.step.schedule import SETTLE, Progress
from stages.training.timing.calibration import ENOUGH, FEWEST, short_of
from stages.training.timing.deadline import Deadline, Pace, rehearse
from tests.made.training import fit_of, make_clip, run, same

clip = pytest.fixture(scope="module")(make_clip)
HALF_UNTIL = Params().half_until
PACE = Pace(half=(0.1, 0.2), full=(0.3, 0.6), half_until=HALF_UNTIL)


class Time:
    """A clock that is put forward by hand."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr("stages.training.timing.deadline.time.perf_counter", lambda: self.now)


def test_a_pace_is_that_of_the_corners_and_between_them():
    assert PACE.mean(0.0, 0.05) == pytest.approx(0.1) and PACE.mean(0.7) == pytest.approx(0.6)
    assert 0.1 < PACE.mean(0.0, HALF_UNTIL) < 0.2 and 0.3 < PACE.mean(HALF_UNTIL, SETTLE) < 0.6
    whole = HALF_UNTIL * PACE.mean(0.0, HALF_UNTIL) + (1 - HALF_UNTIL) * PACE.mean(HALF_UNTIL)
    assert PACE.mean(0.0) == pytest.approx(whole, rel=0.01)


def test_networks_take_their_time_until_they_rest():
    pace = Pace(PACE.half, PACE.full, HALF_UNTIL, networks=(0.5, 0.7))
    assert pace.mean(0.0, 0.7) == pytest.approx(PACE.mean(0.0, 0.7) + 0.5)
    assert pace.mean(0.7) == PACE.mean(0.7) and pace.last == PACE.last


STEPS = {
    "synthetic": (True, (78, 91, 100, 122, 145, 122, 118, 127)),
    "kitchen": (True, (85, 102, 114, 169, 211, 196, 164, 167)),
    "courtyard": (True, (72, 77, 86, 120, 145, 131, 118, 112)),
    "juggler": (False, (50, 51, 53, 77, 75, 48, 41, 41)),
    "treadmill": (False, (53, 55, 57, 65, 75, 51, 45, 41)),
    "spin": (False, (44, 48, 49, 53, 61, 39, 35, 36)),
}
"""Clip -> whether it has a scene, and ms a step in each eighth of its training: `default`, 2 idle cores of Zen 4, November 2026."""


@pytest.mark.parametrize(("scene", "each"), STEPS.values(), ids=STEPS)
def test_what_steps_still_take_is_known_on_the_way(scene, each):
    params, spent, whole = Params(), 0.0, sum(each) / 1000 * Params().steps / len(each)
    progress = Progress(params.steps, joint=True)
    fit = SimpleNamespace(progress=progress, params=params, half_until=HALF_UNTIL, people=[1], scene=scene or None)
    training = Training(SimpleNamespace(params=params), fit)
    for progress.step in range(1, params.steps):
        spent += each[len(each) * (progress.step - 1) // params.steps] / 1000
        if progress.step % 25 == 0:
            training.mark(spent)
        if 0.2 <= progress.done <= 0.6 and progress.step % 70 == 0:
            left = (params.steps - progress.step) * training.pace.mean(progress.done)
            assert left == pytest.approx(whole - spent, rel=0.25)


def test_a_training_without_networks_does_not_wait_for_them():
    for triplane in (False, True):
        params = Params(triplane=triplane)
        fit = SimpleNamespace(params=params, half_until=HALF_UNTIL, people=[1], scene=None)
        assert (Training(SimpleNamespace(params=params), fit).pace.networks[0] > 0) == triplane


def test_as_many_steps_as_fit_and_at_least_one():
    assert PACE.steps(60.0, 0.7) == 100 and PACE.steps(-5.0) == 1


def test_more_steps_are_nearer_to_10_000_and_none_is_beyond():
    assert short_of(1000) == pytest.approx(1.1) and 0.3 < short_of(2000) < 0.8
    assert short_of(10) == pytest.approx(5.4) and short_of(50_000) == 0


def test_what_was_slow_is_believed_to_stay_slow():
    pace = Pace(PACE.half, PACE.full, HALF_UNTIL)
    expected = 50 * pace.mean(0.0, 0.2)
    pace.learn(1.5 * expected, 50, 0.0, 0.2)
    assert pace.slow == pytest.approx(1.5) and pace.mean(0.7) == pytest.approx(0.9)
    pace.learn(1.0, 0, 0.2, 0.2)
    assert pace.slow == pytest.approx(1.5), "no steps teach nothing"


@pytest.mark.slow
def test_a_rehearsal_leaves_no_trace(clip):
    fit, other = fit_of(clip), fit_of(clip)
    pace = rehearse(fit)
    assert same(fit, other) and fit.progress.total == other.progress.total
    run(fit, 12), run(other, 12)
    assert same(fit, other)
    assert all(seconds > 0 for seconds in (*pace.half, *pace.full))


@pytest.mark.parametrize(
    ("group", "lpips", "timed"), [(6, 0, 6), (3, 0, 6), (4, 0, 4), (4, 3, 12), (5, 7, 5), (30, 0, 30)]
)
def test_what_is_timed_is_whole_groups_of_steps_and_a_full_step_even_where_training_has_none(
    clip, monkeypatch, group, lpips, timed
):
    clock, fit, seen = Time(monkeypatch), fit_of(clip), []
    fit.params = fit.params.model_copy(update={"views_per_decode": group, "perceptual_every": lpips})
    fit.half_until = 1.0

    def advance() -> None:
        seen.append(fit.progress.done < fit.half_until)
        clock.now += 1

    monkeypatch.setattr(fit, "advance", advance)
    rehearse(fit, 1)
    steps = 2 + timed  # two to warm up
    assert seen == 2 * (steps * [True] + steps * [False]), "small and large, at two sizes"
    assert fit.half_until == 1.0


def test_filled_up_sets_are_at_their_caps(clip):
    fit = fit_of(clip)
    run(fit, 4)
    fit.densifier.fill_up(fit.adam)
    assert fit.sizes() == {"human": 300, "scene": 260}
    run(fit, 6)
    fit.densifier.params = fit.params.model_copy(update={"scene_cap": 20 * 260})
    fit.densifier.fill_up(fit.adam)
    assert fit.sizes()["scene"] == 20 * 260, "more than four doublings away"


@pytest.mark.slow
def test_a_run_with_other_steps_goes_through_the_whole_schedule(clip):
    fit = fit_of(clip, steps=40)
    run(fit, 10)
    assert fit.progress.done == 0.25
    fit.progress.retime(60)
    assert fit.progress.done == 0.25 and fit.progress.total == 70
    seen = []
    while fit.progress.step < fit.progress.total:
        seen.append(fit.progress.done)
        fit.advance()
    assert seen == sorted(seen) and seen[-1] == pytest.approx(0.25 + 0.75 * 59 / 60) and fit.progress.done == 1.0
    assert len(fit.scene) > 150 and len(fit.people[0].human) > 162


@pytest.mark.parametrize("slower", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("pause", [0.0, 4.0])
@pytest.mark.parametrize("disturbed", [1.0, 8.0])
def test_training_ends_when_the_time_is_over_whatever_the_machine_does(clip, monkeypatch, slower, pause, disturbed):
    """Seconds are those of a made-up machine, which turns `slower` as fast after a quarter of the way; it was at other
    work while small pictures were rehearsed, so that large ones seem to take no longer than those."""
    clock, fit = Time(monkeypatch), fit_of(clip, steps=40)
    half = tuple(disturbed * seconds for seconds in PACE.half)
    monkeypatch.setattr("stages.training.timing.deadline.rehearse", lambda *a: Pace(half, PACE.full, HALF_UNTIL))
    monkeypatch.setattr("stages.training.timing.deadline.ENOUGH", 0)
    deadline = Deadline(seconds=300.0, reserve=10, least=10, began=0.0, pauses=12)
    fit.progress.retime(deadline.start(fit))
    planned, pauses = fit.progress.total, 0
    monkeypatch.setattr(fit, "advance", lambda: setattr(fit.progress, "step", fit.progress.step + 1))
    while fit.progress.step < fit.progress.total:
        clock.now += PACE._at(fit.progress.done) * (1 if fit.progress.done < 0.25 else slower)
        fit.advance()
        if fit.progress.step == fit.progress.total or fit.progress.share * 12 >= pauses + 1:
            pauses += 1
            clock.now += pause
            deadline.add_pause(pause)
        if fit.progress.step < fit.progress.total:
            deadline.mark(fit)
    left_over = 10 * 0.6 * slower
    assert pauses == 12 and abs(clock.now + left_over - 300) < 0.02 * 300
    if disturbed != 1:
        return
    if slower != 1:
        assert (fit.progress.total > 1.2 * planned) if slower < 1 else (fit.progress.total < 0.7 * planned)
    elif not pause:  # it was reckoned with 3.6 s of pause a mark
        assert planned < fit.progress.total < 1.25 * planned


def test_a_deadline_goes_on_where_it_was_stopped(clip, monkeypatch):
    clock, fit = Time(monkeypatch), fit_of(clip)
    deadline = Deadline(100.0, 50, 0, began=0.0, pauses=4, extra=8)
    deadline.pace, deadline.pause = Pace(PACE.half, PACE.full, HALF_UNTIL), 5.0
    clock.now = 30.0
    for hurried in (False, True):
        if hurried:
            deadline.hurry()
        state = deadline.state()
        clock.now += 1000.0
        other = Deadline(100.0, 50, 0, began=clock.now - 10, pauses=12, extra=8)
        other.load(state, fit)
        assert other.spent == pytest.approx(10 + state[0]) and other.hurried is hurried
        assert other.left == pytest.approx(100 - other.spent - 4 * 5 - (0 if hurried else 50 * 0.6 + 8 * 5))


@pytest.mark.parametrize("slower", [1.0, 50.0])
def test_a_training_that_becomes_too_slow_leaves_less_over_and_takes_the_fewest_steps(clip, monkeypatch, slower):
    clock, fit = Time(monkeypatch), fit_of(clip, steps=40)
    monkeypatch.setattr("stages.training.timing.deadline.rehearse", lambda *a: Pace(PACE.half, PACE.full, HALF_UNTIL))
    deadline = Deadline(600.0, reserve=300, least=30, began=0.0, pauses=0)
    fit.progress.retime(deadline.start(fit))
    assert ENOUGH < fit.progress.total < 1500
    for _ in range(100):
        clock.now += slower * PACE._at(fit.progress.done)
        fit.progress.step += 1
    deadline.mark(fit)
    assert deadline.hurried is (slower > 1) and deadline.reserve == (30 if slower > 1 else 300)
    assert fit.progress.total == FEWEST if slower > 1 else fit.progress.total > ENOUGH


@pytest.mark.slow
@pytest.mark.parametrize("late", [-100.0, -1.0, 0.0, 1.0])
def test_what_is_left_of_a_late_training_is_what_its_steps_take(monkeypatch, late):
    Time(monkeypatch)
    deadline = Deadline(60.0, reserve=0, least=0, began=late - 60.0, pauses=2)
    deadline.pace, deadline.pause = Pace((1.0, 1.0), (1.0, 1.0), 0.0), 3.0
    progress = Progress(100, joint=True)
    assert deadline.to_go(progress) == pytest.approx(106)
    progress.step = 90
    assert deadline.to_go(progress) == pytest.approx(16)
    progress.step, deadline.pauses = 100, 0
    assert deadline.to_go(progress) == max(0, late)


def test_slow_steps_are_timed_no_longer_than_the_time_can_bear(clip, monkeypatch):
    """A made-up clock: a step takes ten seconds."""
    clock, fit, taken = Time(monkeypatch), fit_of(clip), []
    monkeypatch.setattr(fit, "advance", lambda: (taken.append(1), setattr(clock, "now", clock.now + 10)))
    for seconds, timings in ((1e6, 3), (0.0, 1)):
        taken.clear()
        assert rehearse(fit, 3, seconds).full == (10.0, 10.0)
        assert len(taken) == 4 * (2 + 4 * timings)

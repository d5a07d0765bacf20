"""What a time asks of a training: fewer steps, smaller sizes, fewer effects, and what gives way first."""

import pytest

from stages.training.timing import budget
from stages.training.timing.budget import fit_into_time, too_dear
from stages.training.timing.calibration import CURVE, ENOUGH, FEWEST
from stages.training.timing.deadline import Deadline, Pace
from tests.made.training import fit_of, make_clip

clip = pytest.fixture(scope="module")(make_clip)
SECOND = Pace((1.0, 1.0), (1.0, 1.0), 0.4)


@pytest.fixture
def second(monkeypatch):
    """A made-up machine: every step takes a second, and no time goes by."""
    monkeypatch.setattr("stages.training.timing.deadline.time.perf_counter", lambda: 0.0)
    monkeypatch.setattr("stages.training.timing.deadline.rehearse", lambda *a: SECOND)


def fitted(clip, seconds, reserve, least, effects=(), monkeypatch=None):
    """The training and the choice for a time, what was said, and how often it was built anew."""
    fit, said, built = fit_of(clip), [], []
    if monkeypatch:
        monkeypatch.setattr(budget, "effects_of", lambda fit: list(effects))
    deadline = Deadline(seconds, reserve, least, 0.0, pauses=12, extra=24)

    def rebuilt(choice):
        built.append(choice)
        return fit_of(clip)

    return *fit_into_time(fit, fit.params, deadline, rebuilt, said.append), said, built, deadline


def test_an_effect_that_costs_more_than_it_wins_is_left_out_of_a_short_training_only():
    assert too_dear(["shadow", "motion_blur"], 250) == ("motion_blur",)
    assert too_dear(["shadow", "motion_blur"], 5000) == ()
    assert too_dear(["nobody_measured_it"], 10) == ()


def test_time_enough_leaves_all_as_it_was(clip, second):
    fit, choice, _, _, deadline = fitted(clip, 2000.0, 100, 10)
    assert fit.progress.total == 2000 - 100 - 36 * 6 and not deadline.hurried and "curve_points" not in choice.settings


def test_what_comes_after_training_gives_way_first(clip, second):
    fit, choice, said, _, deadline = fitted(clip, 800.0, 300, 20)
    assert deadline.hurried and choice.settings["curve_points"] == CURVE
    assert fit.progress.total == 800 - 20 - CURVE * 6 > ENOUGH and not any("late" in text for text in said)


def test_effects_that_are_too_dear_are_left_out_and_named(clip, second, monkeypatch):
    _, choice, said, built, _ = fitted(clip, 300.0, 0, 0, ["motion_blur", "shadow"], monkeypatch)
    assert choice.left_out == ("motion_blur",) and built == [choice]
    assert any("effects left out, since more steps gain more: motion blur" in text for text in said)


def test_a_time_that_is_too_short_ends_late_and_says_by_how_much(clip, second):
    fit, _, said, _, _ = fitted(clip, 60.0, 300, 20)
    assert fit.progress.total == FEWEST
    fits = 60 - 20 - CURVE * 6
    assert any(f"{fits} steps would fit" in text and f"about {FEWEST - fits} s late" in text for text in said)

"""What effects are worth in a finished training: told without a trace, and as drawing without them tells it."""

import pytest
import torch

from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shading import Shading
from stages.estimators.detectors.every import DETECTORS
from stages.training.results import learned_numbers
from stages.training.step.optimizers import optimizers
from stages.training.timing.accuracy import heldout_accuracy
from stages.training.timing.effect_gains import ONLY_TAUGHT, OPTIONS, PARTS, effect_gains, effects_of, without
from stages.training.views import frame_speeds
from tests.made.training import everything, fit_of, make_clip, run, same, twin

clip = pytest.fixture(scope="module")(make_clip)
HELD_OUT = [2]


@pytest.fixture(autouse=True)
def once(monkeypatch):
    """A number is measured once, not as often as gives a true one."""
    monkeypatch.setattr("stages.training.timing.effect_gains.TURNS", 1)


@pytest.fixture(scope="module")
def changing(clip):
    """A training in which all that frames can do is on, and learned to something that shows, and how exact it is.

    A test changes a copy of it.
    """
    fit = everything(clip, 24)
    run(fit, 24)
    effects = FrameEffects.starting(torch.tensor([0.0, 0, -1]), 0.5, motion_blur=True, rolling_shutter=True)
    effects.clothes, effects.shading = fit.effects.clothes, Shading(torch.linspace(-0.5, 0.5, 24).view(8, 3))
    fit.effects, fit.speeds = effects, frame_speeds(fit.full)
    fit.options = fit.options._replace(refine_camera=True)
    fit.adam = optimizers(
        fit.frames, {"person 1": (fit.people[0].human, fit.people[0].corrections)}, fit.scene, 1.0, effects
    )
    fit.densifier.settled = torch.zeros(len(fit.scene.means), dtype=torch.bool)
    with torch.no_grad():
        fit.effects.readout.fill_(0.8), fit.people[0].body.clothing.swings.fill_(0.2)
        (
            fit.scene.shN.fill_(0.05),
            fit.frames.gain.weight[1].fill_(0.3),
            fit.people[0].corrections.place.weight.fill_(0.02),
            fit.people[0].corrections.face.weight[:, :3].fill_(0.3),
        )
        fit.frames.shift.weight[:3] = 0.02
    return fit, heldout_accuracy(fit.cast(), fit.seen(), HELD_OUT)


def everything_of(fit):
    parts = [getattr(fit.effects, part) for part in PARTS.values() if part != "transients"]
    return [fit.transients, fit.options, fit.speeds, fit.scene.shN, fit.scene.antialias, *parts]


def test_every_effect_that_survey_looks_for_can_be_taken_out_but_two():
    assert set(DETECTORS) - {*OPTIONS, *PARTS, "view_dependence"} == {"lens", "sky"}


@pytest.mark.slow
def test_it_leaves_no_trace(clip):
    fit, other = everything(clip, 16), everything(clip, 16)
    run(fit, 9), run(other, 9)
    spent = dict(fit.clock.seconds)
    found = effect_gains(fit, HELD_OUT, HELD_OUT[:1])
    assert list(found) == effects_of(fit)
    assert set(found) == {
        "pose_refinement",
        "exposure",
        "antialias",
        "face",
        "clothing",
        "transients",
        "view_dependence",
    }
    assert same(fit, other) and fit.progress.total == other.progress.total and fit.clock.seconds == spent
    assert fit.densifier.settled is None or torch.equal(fit.densifier.settled, other.densifier.settled)
    run(fit, 16), run(other, 16)
    assert same(fit, other)


@pytest.mark.slow
@pytest.mark.parametrize("effect", [*OPTIONS, *PARTS, "view_dependence"])
def test_it_is_what_held_out_frames_lose_without_the_effect(changing, effect):
    fit, whole = twin(changing[0]), changing[1]
    kept = everything_of(fit)
    with without(fit, effect):
        assert effect not in effects_of(fit) and len(effects_of(fit)) == len(OPTIONS) + len(PARTS)
        drawn = heldout_accuracy(fit.cast(), fit.seen(), HELD_OUT)
        fit.advance()
    assert all(a is b for a, b in zip(kept, everything_of(fit), strict=True))
    assert (drawn["psnr"] == whole["psnr"]) == (effect in ONLY_TAUGHT), "else this test says nothing"


@pytest.mark.slow
def test_the_numbers_are_those_of_drawing_and_of_steps(changing, monkeypatch):
    """A made-up clock: three pictures take three times as long as one."""
    fit, whole = twin(changing[0]), changing[1]
    monkeypatch.setattr("stages.training.timing.effect_gains._seconds", lambda fit: 3.0 if fit.effects.blurs else 1.0)
    far = heldout_accuracy(fit.cast(), fit.seen(), HELD_OUT[:1])
    found = effect_gains(fit, HELD_OUT, HELD_OUT[:1])
    for effect in ("shadow", "clothing", "exposure"):
        with without(fit, effect):
            near, new = (heldout_accuracy(fit.cast(), fit.seen(), some) for some in (HELD_OUT, HELD_OUT[:1]))
        assert found[effect]["psnr_person"] == whole["psnr_person"] - near["psnr_person"]
        assert found[effect]["psnr_far"] == far["psnr_person"] - new["psnr_person"]
    assert found["transients"]["psnr"] is None
    shares = {name: effect["share"] for name, effect in found.items()}
    assert shares.pop("motion_blur") == pytest.approx(2 / 3) and set(shares.values()) == {0.0}


def test_nothing_is_timed_where_nothing_is_on(clip, monkeypatch):
    fit = fit_of(clip, scene=False, refine_pose=False, exposure=False)
    monkeypatch.setattr(fit, "advance", lambda: pytest.fail("a step was taken"))
    assert effects_of(fit) == [] and effect_gains(fit, HELD_OUT, HELD_OUT[:1]) == {}
    light = torch.tensor([0.0, 0, -1])
    fit.effects = FrameEffects.starting(light, 0.5, motion_blur=False, rolling_shutter=False)
    assert fit.effects.shadow is not None
    assert effects_of(fit) == [], "where there is no scene no shadow falls"
    assert learned_numbers(fit.effects, fit.scene) == {}, "and nothing is learned of it"
    assert set(learned_numbers(fit.effects, everything(clip).scene)) == {"darkness", "softness", "density", "size"}


@pytest.mark.slow
def test_without_held_out_frames_there_is_only_a_cost(clip):
    fit = everything(clip, 6)
    run(fit, 6)
    found = effect_gains(fit, [], [])
    assert all(effect["psnr"] is None and effect["share"] < 1 for effect in found.values())


def test_a_step_that_fails_while_it_is_timed_leaves_no_trace(clip, monkeypatch):
    fit, other = everything(clip, 6), everything(clip, 6)
    run(fit, 6), run(other, 6)
    advance = fit.advance

    def breaks():
        advance()
        raise FloatingPointError("too many bad steps")

    monkeypatch.setattr(fit, "advance", breaks)
    with pytest.raises(FloatingPointError):
        effect_gains(fit, HELD_OUT, HELD_OUT[:1])
    assert same(fit, other) and fit.progress.total == other.progress.total

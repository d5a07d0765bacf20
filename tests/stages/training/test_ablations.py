"""Each switch of the paper's ablations does what it says, on a tiny clip."""

import numpy as np
import pytest
import torch

from stages.avatar.model.human import COLOR
from stages.training.step import losses
from stages.training.step.fit import Fit
from stages.training.step.person import Starting
from stages.training.step.schedule import phases
from tests.made.training import TRAIN, ellipsoid, make_clip, models, run, settings, states, stored

clip = pytest.fixture(scope="module")(make_clip)


def fit_of(clip, steps: int = 40, lbs_learning: bool = True, triplane: bool = True, **more) -> Fit:
    views, person = clip
    human, wall, generator = models(lbs_learning=lbs_learning, triplane=triplane)
    return Fit(views, TRAIN, [Starting(person, human)], wall, *settings(steps, exposure=True, **more), generator)


@pytest.mark.parametrize("triplane", [True, False])
def test_without_lbs_learning_each_gaussian_keeps_the_weights_it_began_with(clip, triplane):
    kept, learned = (fit_of(clip, 20, lbs, triplane, human_densify=False) for lbs in (False, True))
    began = kept.people[0].human.initial().weights
    for fit in (kept, learned):
        before = fit.people[0].human()[0].means.detach()
        run(fit, 20)
        assert fit.guard.left_out == 0 and not torch.equal(fit.people[0].human()[0].means, before), "the rest learns"
    assert torch.equal(kept.people[0].human()[0].weights, began) and not torch.equal(
        learned.people[0].human()[0].weights, began
    )
    assert len(kept.people[0].reference) == 0, "nothing looks for neighbours that teach nothing"
    named = [name for name, _ in kept.people[0].human.named_parameters()]
    assert named and not [name for name in named if "deformation" in name or "skin" in name]


@pytest.mark.slow
def test_without_densification_the_person_keeps_its_rows_and_the_scene_grows(clip):
    fit = fit_of(clip, human_densify=False)
    run(fit, 40)
    assert len(fit.people[0].human) == len(ellipsoid()[0]) and len(fit.scene) > 150


@pytest.mark.slow
def test_without_the_human_loss_the_picture_teaches_the_person(clip, monkeypatch):
    monkeypatch.setattr(losses, "person_only", lambda *a: pytest.fail("the person was compared alone"))
    monkeypatch.setattr(losses, "outside_person", lambda *a: pytest.fail("person pixels were taken out"))
    fit = fit_of(clip, 50, human_loss=False)
    numbers = [fit.advance() for _ in range(50)]
    assert all(set(n) == {"image"} for n in numbers)
    image = [n["image"] for n in numbers]
    assert np.mean(image[-10:]) < 0.8 * np.mean(image[:10])
    assert fit.people[0].color_grad_sum.max() > 0 and len(fit.people[0].human) > len(ellipsoid()[0]), (
        "its screen gradients are counted"
    )


@pytest.mark.slow
def test_own_corrections_alone_begin_as_with_networks_and_learn(clip):
    free, decoded = fit_of(clip, 50, triplane=False), fit_of(clip, 50)
    for a, b in zip(free.people[0].human()[0], decoded.people[0].human()[0], strict=True):
        assert torch.equal(a, b)
    numbers = run(free, 50)
    assert np.mean(numbers[-10:]) < 0.8 * np.mean(numbers[:10])
    assert free.guard.left_out == 0, "though weights begin where their prior is 0, so its first gradients are sudden"
    human = free.people[0].human
    assert 162 < len(human) <= 300 and {len(p) for p in human.residuals.parameters()} == {len(human)}
    assert all(p.abs().max() > 0 for p in human.residuals.parameters())
    held = {id(p) for group in free.adam["person 1"].param_groups for p in group["params"]}
    assert held == {id(p) for p in free.people[0].human.parameters()}


def test_beside_the_networks_each_gaussian_has_corrections_of_its_own(clip):
    human = fit_of(clip, 80).people[0].human
    assert set(human.residuals()) == {"opacity", "sh", "turn", "scale"}, (
        "place is its point's, skinning weights are shared"
    )
    before = human()[0]
    with torch.no_grad():
        for own in human.residuals().values():
            own[3] += 0.1
    after = human()[0]
    for name in ("opacities", "sh", "rotations", "scales"):
        changed = (getattr(after, name) != getattr(before, name)).reshape(len(human), -1).any(1)
        assert changed.nonzero().flatten().tolist() == [3], name


def test_a_colour_of_its_own_that_nothing_teaches_goes_back_to_the_networks(clip):
    fit = fit_of(clip, 80)
    with torch.no_grad():
        fit.people[0].human.residuals.sh[3] = 0.05
        fit.people[0].human.logits[3] = -30.0  # nothing shows it
    run(fit, 1)
    one = fit.people[0].human.residuals.sh[3].clone()
    run(fit, 8)
    assert (fit.people[0].human.residuals.sh[3].abs() < one.abs()).all() and (one.abs() < 0.05).all()
    assert fit.people[0].color_grad_sum[3] == 0, "and counts as shown by no frame"
    before = fit.people[0].human()[2]
    with torch.no_grad():
        fit.people[0].human.residuals.sh[:] = 0
    told = fit.people[0].human()[2]
    with torch.no_grad():
        fit.people[0].human.residuals.sh[:] = 0.5
    assert (fit.people[0].human()[2] - told).item() == pytest.approx(COLOR * 3 * 0.25, rel=1e-3) and before > told


def test_a_person_who_grows_stays_as_opaque(clip):
    fit = fit_of(clip, 80)
    before = fit.people[0].human()[0].opacities
    fit.densifier.grow_people(fit.adam, 0.0, 1)
    after = fit.people[0].human()[0].opacities
    assert len(after) > len(before)
    light = [(1 - opacities).log().sum().item() for opacities in (before, after)]
    assert light[1] == pytest.approx(light[0], rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("triplane", [True, False])
def test_adam_moments_of_own_corrections_follow_growth(clip, triplane):
    fit = fit_of(clip, 80, triplane=triplane)
    run(fit, 6)
    last = fit.adam["person 1"].state[fit.people[0].human.residuals.scale]
    fit.densifier.grow_people(fit.adam, 0.0, 1)
    now, moments = fit.people[0].human.residuals.scale, fit.adam["person 1"].state[fit.people[0].human.residuals.scale]
    assert len(moments["exp_avg"]) == len(moments["exp_avg_sq"]) == len(now) > 162
    assert moments["step"] == last["step"] == 6 and (moments["exp_avg_sq"][-1] == 0).all()
    assert (moments["exp_avg_sq"][:10] > 0).any(), "rows that stay keep theirs"


@pytest.mark.slow
@pytest.mark.parametrize("case", [{"triplane": False}, {"joint": False}, {"human_loss": False, "lbs_learning": False}])
def test_resumed_equals_uninterrupted_bit_for_bit(clip, case):
    straight, first = fit_of(clip, 20, **case), fit_of(clip, 20, **case)
    run(straight, 20)
    run(first, 15)  # behind growth of the scene and of the person, in the second phase where there are two
    second = fit_of(clip, 20, **case)
    second.load(stored(first))
    assert len(second.scene) > 150
    run(second, 20)
    for key, value in states(straight).items():
        assert torch.equal(value, states(second)[key]), key


def test_scene_first_then_the_person_before_a_scene_that_no_gradient_reaches(clip):
    fit = fit_of(clip, joint=False)
    numbers = [fit.advance() for _ in range(20)]
    assert all(set(n) == {"image"} for n in numbers) and len(fit.scene) > 150
    began = fit_of(clip, joint=False)
    for key, value in states(began).items():
        assert key.startswith(("scene.", "frames.gain")) or torch.equal(value, states(fit)[key]), key
    scene = {k: v for k, v in states(fit).items() if k.startswith("scene.")}
    seen, person = [], states(fit)
    for parameter in fit.scene.parameters():
        parameter.register_hook(lambda grad: seen.append(grad))
    numbers = [fit.advance() for _ in range(20)]
    assert any("person 1" in n for n in numbers) and fit.progress.step == fit.params.steps
    assert not seen and all(torch.equal(v, states(fit)[k]) for k, v in scene.items())
    assert len(fit.people[0].human) > 162 and not torch.equal(
        person["person 1.triplane.table"], fit.people[0].human.triplane.table
    )


def test_the_scene_alone_learns_from_background_pixels_only(clip, monkeypatch):
    monkeypatch.setattr(losses, "SSIM_SHARE", 0.0)  # its windows reach over the outline
    views, person = clip
    dark = views._replace(images=torch.where(views.masks[..., None] == 255, 0, views.images))
    fits = [fit_of((v, person), joint=False) for v in (views, dark)]
    assert (views.masks == 255).any()
    for fit in fits:
        fit.small = fit.full  # smaller pictures mix both into pixels of the outline
        run(fit, 20)
    first, second = map(states, fits)
    assert all(torch.equal(first[key], value) for key, value in second.items())


def test_frames_without_a_person_teach_nothing_in_the_second_phase(clip):
    views, person = clip
    fit = fit_of((views._replace(masks=torch.zeros_like(views.masks)), person), 8, joint=False)
    run(fit, 4)
    before = states(fit)
    assert [fit.advance() for _ in range(4)] == [{}] * 4
    assert all(torch.equal(v, states(fit)[k]) for k, v in before.items())


@pytest.mark.parametrize("steps", [1, 2, 7, 4000])
def test_phases_share_out_all_steps(steps):
    assert phases(steps, True) == ((0, steps, True, True, 0.0),)
    scene, person = phases(steps, False)
    assert scene.first == 0 and person.first == scene.steps and scene.steps + person.steps == steps
    assert (scene.human, scene.scene, person.human, person.scene) == (False, True, True, False)

"""Several people in one training: each learns their own colours, who is not there is not drawn, and it resumes bit for bit."""

import numpy as np
import pytest
import torch

from stages.avatar.rasterize import Camera
from stages.training.step import densify, layers
from stages.training.timing.accuracy import heldout_accuracy
from stages.training.views import Views
from tests.made.training import FRAMES, HEIGHT, WIDTH, run, same, stored
from tests.made.two import fit_of_two, make_two

clip = pytest.fixture(scope="module")(make_two)


@pytest.mark.slow
def test_both_learn_their_own_colours_and_grow(clip):
    fit = fit_of_two(clip, steps=60)
    began, before = [len(learner.human) for learner in fit.people], heldout_accuracy(fit.cast(), fit.seen(), [2])
    numbers = run(fit, 60)
    assert np.mean(numbers[-10:]) < 0.8 * np.mean(numbers[:10]) and fit.guard.left_out == 0
    assert all(len(learner.human) > count for learner, count in zip(fit.people, began))
    with torch.no_grad():
        red, blue = (learner.baked()[0].sh[:, 0].mean(0) for learner in fit.people)
    assert red[0] > red[2] + 0.3 and blue[2] > blue[0] + 0.3
    assert heldout_accuracy(fit.cast(), fit.seen(), [2])["psnr_person"] > before["psnr_person"] + 1


@pytest.mark.slow
def test_two_resumed_are_as_two_that_were_not_stopped(clip):
    straight, first, second = fit_of_two(clip), fit_of_two(clip), fit_of_two(clip)
    run(straight, 20)
    run(first, 11)
    second.load(stored(first))
    run(second, 20)
    assert same(straight, second) and {"person 2", "frames of person 2"} <= set(second.modules())


@pytest.mark.slow
def test_two_who_change_places_get_each_others_results(clip, monkeypatch):
    """Random numbers come in the order of people, so here all have the same. What is left are sums in another order."""
    layer, displacement = layers.Layer, densify.displacement

    def same_background(rows=None, window=None, background=None):
        return layer(rows, window, None if background is None else torch.full_like(background, 0.3))

    def same_places(axes, rows, _):
        return displacement(axes, rows, torch.Generator().manual_seed(0))

    monkeypatch.setattr(layers, "Layer", same_background)
    monkeypatch.setattr(densify, "displacement", same_places)
    straight, turned = (fit_of_two(clip, 12, order) for order in ((0, 1), (1, 0)))
    for fit in (straight, turned):
        run(fit, 12)
    assert len(straight.scene) == len(turned.scene) > 150
    for one, other in zip(straight.people, reversed(turned.people), strict=True):
        assert len(one.human) == len(other.human) > 162
        found, expected = straight.baked(one).splats(2), turned.baked(other).splats(2)
        for name in ("means", "axes", "opacities", "sh"):
            assert (getattr(found, name) - getattr(expected, name)).abs().mean() < 1e-3, name
    camera = Camera(clip[0].viewmats[2], clip[0].Ks[2], WIDTH, HEIGHT)
    picture, other = (fit.cast().at(2).draw(camera)[0].image for fit in (straight, turned))
    assert (picture - other).abs().mean() < 1e-3 < picture.std()


@pytest.mark.slow
def test_one_who_is_not_there_is_not_drawn(clip):
    views, people, masks = clip
    gone = [masks[0], masks[1].clone()]
    gone[1][:3] = 0
    away = Views(views.images, torch.maximum(*gone), *views[2:])
    fit = fit_of_two((away, people, gone), steps=4)
    assert [len(fit.drawn_people(i, fit.full)) for i in range(FRAMES)] == [1, 1, 1, 2, 2, 2]
    run(fit, 4)
    assert fit.guard.left_out == 0


@pytest.mark.slow
def test_without_a_scene_a_frame_in_which_nobodys_pose_is_known_is_not_measured(clip):
    """Their masks are there, but in held-out frame 2 no landmarks were found."""
    views, people, masks = clip
    found = torch.arange(FRAMES) != 2
    people = [person._replace(confidence=found.float()) for person in people]
    fit = fit_of_two((views, people, masks))
    fit.scene = None
    assert set(heldout_accuracy(fit.cast(), fit.seen(), [2]).values()) == {None}
    assert heldout_accuracy(fit.cast(), fit.seen(), [1, 2]) == heldout_accuracy(fit.cast(), fit.seen(), [1])

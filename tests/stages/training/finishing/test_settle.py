"""Colours make up for what finishing has changed: as far as they are their own, and by nobody else's pixels."""

import pytest
import torch

from stages.avatar.model.person import rest
from stages.training.accuracy import heldout_accuracy
from stages.training.finishing.settle import settle_colors
from stages.training.fit import Fit
from tests.made.training import TRAIN, ellipsoid, make_clip, models, settings
from tests.made.two import fit_of_two, make_two

clip = pytest.fixture(scope="module")(make_clip)


def true_fit(clip, scene: bool = True, **more):
    """A training whose scene is that of `make_clip`, and the person as they truly are."""
    views, body = clip
    human, wall, generator = models(0)
    wall.sh0.data = torch.randn(wall.sh0.shape, generator=generator)
    wall.logit_opacities.data[:] = 3
    wall.log_scales.data += 1
    fit = Fit(views, TRAIN, body, human, wall if scene else None, *settings(40, **more), generator)
    with torch.no_grad():
        return fit, human()[0]._replace(sh=torch.sin(8 * ellipsoid()[0])[:, None] * 1.5)


def accuracy(fit, person) -> float:
    """Of the held-out frame, in the box of this person."""
    fit.person.baked = lambda: (person, rest(person, fit.person.canonical_bones))
    return heldout_accuracy(fit, [2])["psnr_person"]


def settled(fit, person, own, frames=TRAIN):
    return settle_colors(fit, fit.person, person, own, frames)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [True, False])
def test_spoiled_colours_come_back_and_those_that_are_not_their_own_stay(clip, scene):
    fit, truth = true_fit(clip, scene)
    spoiled = truth._replace(sh=truth.sh + 0.4)
    own = torch.ones(len(truth.means))
    own[::3] = 0
    back = settled(fit, spoiled, own)
    assert torch.equal(back.sh[::3], spoiled.sh[::3]) and not torch.equal(back.sh[1::3], spoiled.sh[1::3])
    assert all(a is b for name, a, b in zip(back._fields, back, spoiled, strict=True) if name != "sh")
    assert accuracy(fit, back) > accuracy(fit, spoiled) + 3
    assert accuracy(fit, settled(fit, spoiled, torch.ones_like(own))) > accuracy(fit, spoiled) + 6
    half = settled(fit, spoiled, 0.5 * torch.ones_like(own))
    assert (half.sh - spoiled.sh).abs().max() < (
        settled(fit, spoiled, torch.ones_like(own)).sh - spoiled.sh
    ).abs().max()


@pytest.mark.slow
def test_true_colours_hardly_move(clip):
    fit, truth = true_fit(clip)
    assert accuracy(fit, truth) > 50 and accuracy(fit, settled(fit, truth, torch.ones(len(truth.means)))) > 35


@pytest.mark.slow
def test_exposure_of_a_frame_is_not_taken_for_a_colour(clip):
    views, body = clip
    gains = torch.linspace(-0.4, 0.4, len(views.images)).exp()[:, None, None, None]
    lit = views._replace(images=(views.images * gains).clamp(0, 255).round().byte())
    fit, truth = true_fit((lit, body), exposure=True)
    with torch.no_grad():
        fit.frames.gain.weight[:] = gains.view(-1, 1).log()
    plain, _ = true_fit((lit, body))
    own, bright = torch.ones(len(truth.means)), [4, 5]
    taken = settled(plain, truth, own, bright)
    assert accuracy(fit, settled(fit, truth, own, bright)) > accuracy(fit, taken) + 5


@pytest.mark.slow
def test_pixels_of_others_are_not_compared():
    views, people, masks = make_two()
    red = torch.where((masks[1] == 255)[..., None], torch.tensor([255, 0, 0], dtype=torch.uint8), views.images)
    one, other = (fit_of_two((views._replace(images=images), people, masks)) for images in (views.images, red))
    person, _ = one.person.baked()
    own = torch.ones(len(person.means))
    apart = (settled(one, person, own).sh - settled(other, person, own).sh).abs().mean()
    assert apart < 0.1 * (settled(one, person, own).sh - person.sh).abs().mean()

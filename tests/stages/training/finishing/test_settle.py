"""Gaussians settle by themselves: as far as frames tell of each, by no pixel of anybody else, with and without a scene."""

import pytest
import torch

from stages.avatar.body.smpl import DA_POSE
from stages.avatar.model.person import Canonical, bone_transforms, rest
from stages.avatar.splats.neighbours import nearest
from stages.training.finishing import settle as module
from stages.training.finishing.bake import Known
from stages.training.finishing.settle import SEAM, Change, settle, uneven
from stages.training.step.fit import Fit
from stages.training.step.person import Starting
from stages.training.timing.accuracy import heldout_accuracy
from tests.made.skeleton import PARENTS
from tests.made.training import TRAIN, ellipsoid, make_clip, models, settings
from tests.made.two import fit_of_two, make_two

clip = pytest.fixture(scope="module")(make_clip)


@pytest.fixture(autouse=True)
def sooner(monkeypatch):
    """Two fifths of the steps settle people of so few pixels."""
    monkeypatch.setattr(module, "STEPS", 100)


def true_fit(clip, scene: bool = True, **more):
    """A training whose scene is that of `make_clip`, and the person as they truly are."""
    views, body = clip
    human, wall, generator = models(0)
    wall.sh0.data = torch.randn(wall.sh0.shape, generator=generator)
    wall.logit_opacities.data[:] = 3
    wall.log_scales.data += 1
    fit = Fit(views, TRAIN, [Starting(body, human)], wall if scene else None, *settings(40, **more), generator)
    with torch.no_grad():
        return fit, human()[0]._replace(sh=torch.sin(8 * ellipsoid()[0])[:, None] * 1.5)


def accuracy(fit, person) -> float:
    """Of the held-out frame, in the box of this person."""
    fit.people[0].baked = lambda: (person, rest(person, fit.people[0].canonical_bones))
    return heldout_accuracy(fit.cast(), fit.seen(), [2])["psnr_person"]


def settled(fit, person, own, frames=TRAIN, told=None, aslant=0.0, number=0, learned=1400):
    """With colours that are their own[N], and sizes and places that frames tell as well, or told[N,3]; after `learned` steps."""
    told = own[:, None].expand(-1, 3) if told is None else told
    who, known = fit.baked(fit.people[number]), Known(own, told, torch.full_like(own, aslant))
    return settle(who, person, known, frames, fit.cast([who]), fit.seen(), fit.params.human_loss, learned)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [True, False])
def test_spoiled_colours_come_back_and_what_is_not_their_own_stays(clip, scene):
    fit, truth = true_fit(clip, scene)
    spoiled = truth._replace(sh=truth.sh + 0.4)
    own = torch.ones(len(truth.means))
    own[::3] = 0
    back = settled(fit, spoiled, own)
    for name, now, before in zip(back._fields, back, spoiled, strict=True):
        assert torch.equal(now[::3], before[::3]), name
        assert (now is before) == (name in ("rotations", "weights", "normals")), name
    assert accuracy(fit, back) > accuracy(fit, spoiled) + 3
    whole = settled(fit, spoiled, torch.ones_like(own))
    assert accuracy(fit, whole) > accuracy(fit, spoiled) + 6
    half = settled(fit, spoiled, 0.5 * torch.ones_like(own))
    assert (half.sh - spoiled.sh).abs().max() < (whole.sh - spoiled.sh).abs().max()


@pytest.mark.slow
def test_what_is_true_hardly_changes(clip):
    fit, truth = true_fit(clip)
    assert accuracy(fit, truth) > 50 and accuracy(fit, settled(fit, truth, torch.ones(len(truth.means)))) > 35


@pytest.mark.slow
def test_spoiled_places_and_sizes_come_back_along_the_axes_that_frames_tell(clip, monkeypatch):
    monkeypatch.setattr(module, "STEPS", 160)  # a place moves by 0.2 mm a step
    fit, truth = true_fit(clip)
    generator = torch.Generator().manual_seed(1)
    off = 0.03 * torch.randn(truth.means.shape, generator=generator)
    spoiled = truth._replace(means=truth.means + off, scales=1.3 * truth.scales)
    own, told = torch.zeros(len(off)), torch.ones_like(off)
    told[:, 2] = 0
    back, still = settled(fit, spoiled, own, told=told), settled(fit, spoiled, own, told=0 * told, learned=20)
    assert all(torch.equal(a, b) for a, b in zip(still, spoiled, strict=True))
    assert accuracy(fit, back) > accuracy(fit, spoiled) + 1.5
    moved = (truth.rotations.mT @ (back.means - spoiled.means)[..., None])[..., 0]
    assert moved[:, :2].abs().mean() > 1e-3 and moved[:, 2].abs().max() < 1e-6
    assert torch.equal(back.scales[:, 2], spoiled.scales[:, 2]) and (back.scales < spoiled.scales).float().mean() > 0.4
    assert torch.equal(back.sh, spoiled.sh) and torch.equal(back.opacities, spoiled.opacities)


@pytest.mark.slow
def test_who_is_seen_through_becomes_opaque_though_the_scene_behind_has_their_colours(clip):
    fit, truth = true_fit(clip)
    grey = truth._replace(sh=0 * truth.sh)
    fit.scene.sh0.data[:] = 0
    fit.full = fit.full._replace(images=torch.full_like(fit.full.images, 128))
    thin, own = grey._replace(opacities=0.5 * grey.opacities), torch.ones(len(grey.means))
    gained = lambda: (settled(fit, thin, own).opacities / thin.opacities).mean() - 1  # noqa: E731
    assert gained() > 0.15
    fit.params = fit.params.model_copy(update={"human_loss": False})
    assert gained() < 0, "with the scene alone nothing tells them apart"


@pytest.mark.slow
def test_a_gradient_that_is_not_finite_changes_nobody_else(clip, monkeypatch):
    fit, truth = true_fit(clip)
    spoiled, own = truth._replace(sh=truth.sh + 0.4), torch.ones(len(truth.means))
    real = torch.autograd.grad

    def broken(loss, parts):
        slopes = real(loss, parts)
        slopes[0][7] = torch.nan
        return slopes

    monkeypatch.setattr(module.torch.autograd, "grad", broken)
    monkeypatch.setattr(module, "STEPS", 10)
    back = settled(fit, spoiled, own)
    assert all(part.isfinite().all() for part in back) and torch.equal(back.sh[7], spoiled.sh[7])
    assert not torch.equal(back.sh[8], spoiled.sh[8]) and fit.guard.left_out == 10
    settled(fit, spoiled, own, learned=20)
    assert fit.guard.left_out == 10 + 5, "a short training settles for a quarter of its steps"


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
@pytest.mark.parametrize("number", [0, 1])
def test_pixels_of_others_are_not_compared(number, monkeypatch):
    monkeypatch.setattr(module, "STEPS", 64)
    views, people, masks = make_two()
    ink = torch.tensor([0, 255, 0], dtype=torch.uint8)
    green = torch.where((masks[1 - number] == 255)[..., None], ink, views.images)
    one, other = (fit_of_two((views._replace(images=images), people, masks)) for images in (views.images, green))
    person, _ = one.people[number].baked()
    own = torch.ones(len(person.means))
    plain, spoiled = (settled(fit, person, own, number=number).sh for fit in (one, other))
    assert (plain - spoiled).abs().mean() < 0.1 * (plain - person.sh).abs().mean()


@pytest.mark.slow
def test_specks_that_frames_see_aslant_become_even_and_the_person_looks_better(clip):
    fit, truth = true_fit(clip)
    rough = 0.3 * torch.randn(truth.sh.shape, generator=torch.Generator().manual_seed(4))
    spoiled, own = truth._replace(sh=truth.sh + rough), torch.ones(len(truth.means))
    near = nearest(truth.means, truth.means, 7)[1][:, 1:]
    straight, aslant = (settled(fit, spoiled, own, aslant=share) for share in (0.0, 1.0))
    before, without, after = (float(uneven(p.sh, near, own)) for p in (spoiled, straight, aslant))
    assert after < 0.7 * without and without < 1.5 * before
    assert accuracy(fit, aslant) > accuracy(fit, spoiled) + 0.2


def test_uneven_colours_cost_as_they_are_seen_aslant_and_seams_no_more_than_their_height():
    near, aslant = torch.tensor([[1, 2], [0, 2], [0, 1]]), torch.tensor([1.0, 0.5, 0], dtype=torch.float64)

    def cost(step: float) -> torch.Tensor:
        return uneven(torch.tensor([step, 0, 0], dtype=torch.float64)[:, None, None].expand(-1, 1, 3), near, aslant)

    assert cost(0) == 0
    assert cost(1e-4).item() == pytest.approx(2.5 / 6 * 3 * 1e-8 / (2 * SEAM), rel=1e-4), "square at first"
    assert (cost(100) - cost(50)).item() == pytest.approx(2.5 / 6 * 50 * 3**0.5, rel=1e-3), "linear then"
    even = torch.zeros(3, 1, 3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(uneven(even, near, aslant), even)
    assert (slope == 0).all()
    sh = torch.rand(3, 1, 3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(uneven(sh, near, aslant), sh)
    assert (slope[2] == 0).all() and (slope[:2] != 0).any(), "what is seen straight is not pulled by what is not"


def changes(count: int, **more) -> Change:
    generator = torch.Generator().manual_seed(2)
    shapes = {"sh": (count, 1, 3), "opacity": (count,), "size": (count, 3), "place": (count, 3)}
    return Change(**{name: torch.randn(shape, generator=generator, **more) for name, shape in shapes.items()})


def test_at_rest_people_change_as_at_the_canonical_pose():
    vertices, _, weights = ellipsoid()
    with torch.no_grad():
        person = Canonical(*(part.double() for part in models()[0]()[0]))
    assert torch.equal(person.weights.argmax(1), weights.argmax(1))
    joints = torch.rand(24, 3, generator=torch.Generator().manual_seed(3)).double()
    bones = bone_transforms(joints, PARENTS, torch.zeros(3).double(), DA_POSE.double())
    change = changes(len(vertices), dtype=torch.float64)
    change = change._replace(place=0.01 * change.place)
    for one, other in zip(rest(change.of(person), bones), change.at_rest(rest(person, bones), person.scales)):
        torch.testing.assert_close(one, other)


def test_no_change_is_none_to_the_bit():
    with torch.no_grad():
        person = models()[0]()[0]
    person = person._replace(opacities=torch.linspace(0, 1, len(person.means)))
    none = Change(*(0 * part for part in changes(len(person.means))))
    assert all(torch.equal(a, b) for a, b in zip(none.of(person), person, strict=True))


def test_no_size_doubles_more_than_once():
    change = changes(5)._replace(size=torch.tensor([-1e9, -1.0, 0, 1e-3, 1e9]).repeat_interleave(3).view(5, 3))
    sizes = change.held(torch.ones(5), torch.ones(5, 3)).size[:, 0]
    assert sizes.exp()[[0, 4]].tolist() == pytest.approx([0.5, 2], rel=0.01)
    assert (sizes.diff() > 0).all() and sizes[2] == 0 and sizes[3] == pytest.approx(1e-3, rel=1e-4)


def test_opacities_of_0_and_1_stay_and_have_a_gradient():
    opacities = torch.tensor([0.0, 1e-30, 0.3, 1 - 1e-7, 1], dtype=torch.float64)
    change = changes(5, dtype=torch.float64)
    for logits in (-80.0, 0.0, 80.0):
        by = torch.full((5,), logits, dtype=torch.float64, requires_grad=True)
        found = change._replace(opacity=by).opaque(opacities)
        torch.testing.assert_close(found[1:4], torch.sigmoid(torch.logit(opacities[1:4]) + by[1:4]))
        assert found[0] == 0 and found[4] == 1
        (grad,) = torch.autograd.grad(found.sum(), by)
        assert grad.isfinite().all() and grad[0] == 0 and grad[4] == 0
    torch.autograd.gradcheck(
        lambda o: change._replace(opacity=o).opaque(opacities), torch.zeros_like(by).requires_grad_()
    )

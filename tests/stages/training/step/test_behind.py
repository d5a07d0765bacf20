"""What the person always hides of a scene takes the colours around, and training leaves it alone."""

import pytest
import torch

from stages.avatar.model.scene import SceneModel
from stages.avatar.splats.sh import sh_from_rgb
from stages.training.step.behind import inpaint_occluded
from stages.training.step.fit import Fit
from stages.training.step.schedule import SETTLE
from stages.training.views import Views
from tests.made.training import fit_of, make_clip

clip = pytest.fixture(scope="module")(make_clip)

SIZE, FOCAL = 64, 80.0


def wall(frames=3):
    """A grey wall 4 m away, filmed from three places 0.1 m apart; the masks cover the middle of each picture."""
    side = torch.linspace(-2.0, 2.0, 41)
    points = torch.stack([*torch.meshgrid(side, side, indexing="ij"), torch.full((41, 41), 4.0)], -1).reshape(-1, 3)
    scene = SceneModel(points, torch.full_like(points, 0.5), 0, 4.0)
    viewmats = torch.eye(4).repeat(frames, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(-0.1, 0.1, frames)
    Ks = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]).repeat(frames, 1, 1)
    masks = torch.zeros(frames, SIZE, SIZE).byte()
    masks[:, 16:48, 24:40] = 255
    return scene, Views(torch.zeros(frames, SIZE, SIZE, 3).byte(), masks, viewmats, Ks)


def lit(scene):
    """No shadow anywhere."""
    return lambda frame: torch.zeros(len(scene))


def test_what_is_always_hidden_takes_the_colours_around():
    scene, views = wall()
    middle = (scene.means[:, 0].abs() < 0.15) & (scene.means[:, 1].abs() < 0.6)
    with torch.no_grad():
        scene.sh0[middle] = sh_from_rgb(torch.tensor([[1.0, 0.0, 1.0]]))
    before = scene.sh0.detach().clone()
    hidden = inpaint_occluded(scene, views, [0, 1, 2], lit(scene))
    assert hidden[middle].all() and hidden.sum() < 3 * middle.sum()
    torch.testing.assert_close(scene.sh0[middle], torch.zeros_like(scene.sh0[middle]), atol=1e-6, rtol=0)
    assert torch.equal(scene.sh0[~hidden], before[~hidden])


def test_without_anybody_or_anything_around_colours_stay():
    scene, views = wall()
    before = scene.sh0.detach().clone()
    for masks in (torch.zeros_like(views.masks), torch.full_like(views.masks, 255)):
        assert not inpaint_occluded(scene, views._replace(masks=masks), [0, 1, 2], lit(scene)).any()
    assert torch.equal(scene.sh0, before)


def test_what_is_always_in_the_shadow_takes_the_colours_of_what_is_lit():
    scene, views = wall()
    views = views._replace(masks=torch.zeros_like(views.masks))
    corner = (scene.means[:, 0] < -0.8) & (scene.means[:, 1] < -0.8)
    edge = (scene.means[:, 0] < -0.6) & (scene.means[:, 1] < -0.6) & ~corner
    with torch.no_grad():
        scene.sh0[corner], scene.sh0[edge] = 3.0, 1.0
    before = scene.sh0.detach().clone()
    hidden = inpaint_occluded(scene, views, [0, 1, 2], lambda frame: corner.float() + 0.5 * edge)
    seen = (scene.means[:, :2].abs() < 1.5).all(1)
    assert torch.equal(hidden[seen], corner[seen]), "half a shadow is no reason"
    torch.testing.assert_close(scene.sh0[hidden], torch.zeros_like(scene.sh0[hidden]), atol=1e-6, rtol=0)
    assert torch.equal(scene.sh0[~hidden], before[~hidden])
    once = [1.0, 0.0, 0.0]
    assert not inpaint_occluded(scene, views, [0, 1, 2], lambda frame: once[frame] * corner).any(), (
        "lit in other frames"
    )


def test_nobody_who_is_not_drawn_casts_a_shadow(clip, monkeypatch):
    fit, stances = fit_of(clip, steps=20), []
    monkeypatch.setattr(fit.effects, "shadow_depth", lambda points, there: stances.append(there))
    fit._shadow_depth(0, fit.scene.means)
    fit.full.masks[0] = 0
    fit._shadow_depth(0, fit.scene.means)
    assert [len(there) for there in stances] == [1, 0]


def test_a_colour_that_was_filled_in_is_not_learned_any_more(clip):
    fit: Fit = fit_of(clip, steps=20)
    while fit.progress.done <= SETTLE:
        assert fit.densifier.settled is None
        fit.advance()
    fit.advance()
    assert fit.densifier.settled is not None
    fit.densifier.settled = torch.arange(len(fit.scene)) % 2 == 0
    state = fit.adam["scene"].state[fit.scene.sh0]
    state["exp_avg"][fit.densifier.settled] = 0
    before = fit.scene.sh0.detach().clone(), fit.scene.means.detach().clone()
    fit.advance()
    assert torch.equal(fit.scene.sh0[fit.densifier.settled], before[0][fit.densifier.settled])
    assert not torch.equal(fit.scene.sh0[~fit.densifier.settled], before[0][~fit.densifier.settled])
    assert not torch.equal(fit.scene.means[fit.densifier.settled], before[1][fit.densifier.settled]), (
        "it still gives way"
    )

"""The known defects of the released HUGS code (D1 to D14, no hard cases), each with what would happen if ours had it.

D5, D6 and D7 are about settings, imports and files: tests/hugs_cli/test_pipelines.py, tests/stages/test_train.py and
tests/stages/formats/test_splats.py hold them.
"""

import math

import pytest
import torch

from stages.avatar.measures.lpips import Lpips
from stages.avatar.model.human import HumanModel
from stages.avatar.rasterize import Camera
from stages.training.step import densify, losses
from stages.training.step.patches import SIDE
from stages.training.step.schedule import LR_FRAMES, LR_HUMAN, LR_OWN, LR_SCENE, SETTLE, rate
from tests.made.learned import compose
from tests.made.lpips_weights import small_weights
from tests.made.skin import on_vertices
from tests.made.training import FRAMES, HEIGHT, WIDTH, ellipsoid, fit_of, make_clip, models, run, states

clip = pytest.fixture(scope="module")(make_clip)


def test_defect_1_each_set_is_densified_by_its_own_gradients(clip):
    fit = fit_of(clip)
    with torch.no_grad():
        fit.scene.means[:, 2] -= 100  # behind every camera: no gradient reaches it
    run(fit, 2)
    assert (fit.densifier.statistics["scene"].count == 0).all() and (fit.densifier.statistics["scene"].grad == 0).all()
    assert (fit.densifier.statistics["person 1"].count > 0).float().mean() > 0.9, (
        "the person is drawn, and its rows come first"
    )


def test_defect_2_the_scene_has_view_dependent_colours_whatever_the_person_has(clip):
    human, scene, _ = models()
    assert human()[0].sh.shape[1] == 1 and scene.splats().sh.shape[1] == 4
    fit = fit_of(clip)
    run(fit, 20)
    assert (fit.scene.shN.abs().amax((1, 2)) > 0).float().mean() > 0.9, "and they are learned"
    views, splats = clip[0], fit.scene.splats()
    flat = splats._replace(sh=splats.sh[:, :1])
    camera = Camera(views.viewmats[0], views.Ks[0], WIDTH, HEIGHT)
    looks = [compose(None, s, camera)[0].image for s in (splats, flat)]
    assert (looks[0] - looks[1]).abs().max() > 1e-3


@pytest.mark.slow
def test_defect_3_the_place_of_the_person_is_refined(clip):
    views, person = clip
    shift = 0.05 * torch.randn(FRAMES, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1, 0])
    shift -= shift[[0, 1, 3, 4, 5]].mean(0)  # a shift of all frames alike is nobody's fault
    fit = fit_of((views, person._replace(transl=person.transl + shift)), steps=130, human_cap=170)
    trained = fit.train
    before = shift[trained].norm(dim=1).mean()
    run(fit, 130)
    after = (fit.poses(fit.people[0])[2] - person.transl)[trained]
    assert (after - after.mean(0)).norm(dim=1).mean() < 0.6 * before, "a third of it after 300 steps"


def test_defect_4_a_checkpoint_holds_every_state_that_training_has(clip):
    fit = fit_of(clip)
    run(fit, 20)
    state = fit.state()
    kept = {"person 1", "frames of person 1", "scene", "frames"}
    assert set(state["adam"]) == kept == set(state["models"]) - {"effects"}
    assert {"pose.weight", "place.weight"} <= set(state["models"]["frames of person 1"])
    assert {"gain.weight", "turn.weight", "shift.weight"} <= set(state["models"]["frames"])
    for name, optimizer in state["adam"].items():
        assert all({"step", "exp_avg", "exp_avg_sq"} <= set(moments) for moments in optimizer["state"].values()), name
    assert state["progress"]["step"] == 20 and {"generator", "order", "densifier"} <= set(state)
    again = fit_of(clip)
    again.load(state)
    assert all(torch.equal(value, states(again)[key]) for key, value in states(fit).items())


def test_defect_8_a_background_pixel_teaches_the_same_however_large_the_person_is(monkeypatch):
    monkeypatch.setattr(losses, "SSIM_SHARE", 0.0)
    image = torch.rand(40, 32, 3, generator=torch.Generator().manual_seed(0))
    slopes = []
    for size in (4, 25):
        mask = torch.zeros(40, 32)
        mask[:size, :size] = 1
        rendered = (image + 0.1).requires_grad_()
        losses.photometric(losses.outside_person(rendered, image, mask), image).backward()
        slopes.append(rendered.grad[35, 30])
    assert torch.equal(*slopes) and torch.allclose(slopes[0], torch.tensor(1 / (40 * 32 * 3)))


@pytest.mark.parametrize("size", [0.02, 1.0, 6.0])
def test_defect_9_bodies_of_any_size_and_points_that_drift_away_are_decoded(size):
    vertices, faces, weights = ellipsoid()
    sizes = {"channels": 8, "resolution": 24}
    human = HumanModel(
        on_vertices(size * vertices, faces, weights), **sizes, generator=torch.Generator().manual_seed(0)
    )
    with torch.no_grad():
        human.xyz[0] *= 50
    person, stray, _ = human()
    assert all(part.isfinite().all() for part in person) and stray > 0
    stray.backward()
    assert (human.xyz.grad[0] * human.xyz[0]).sum() > 0 and (human.xyz.grad[1:] == 0).all(), "it is drawn back"


@pytest.mark.parametrize("turn", [[-1.0, 0, 0, 0, -1, 0], [1.0, 0, 0, 1, -1, 0], [1e4, 0, 0, 1e4, 0, 0], [0.0] * 6])
def test_defect_10_scales_are_positive_and_frames_rotations_whatever_networks_say(turn):
    human, _, _ = models()
    with torch.no_grad():
        last = human.decoders.geometry[-1]
        last.bias[3:9], last.bias[9:] = torch.tensor(turn), torch.tensor([-1e6, 1e6, 0])
    person, *_ = human()
    assert (person.scales > 0).all() and person.scales.isfinite().all()
    identity = torch.eye(3).expand(len(human), 3, 3)
    assert torch.allclose(person.rotations.mT @ person.rotations, identity, atol=1e-5)
    assert torch.allclose(torch.linalg.det(person.rotations), torch.ones(len(human)), atol=1e-5)


def test_defect_11_the_principal_point_counts(clip):
    views, _ = clip
    _, scene, _ = models()
    K = views.Ks[0].clone()
    K[0, 2], K[1, 2] = K[0, 2] + 5, K[1, 2] - 3
    cameras = (Camera(views.viewmats[0], k, WIDTH, HEIGHT) for k in (views.Ks[0], K))
    there, moved = (compose(None, scene.splats(), camera)[0].image for camera in cameras)
    assert there[3:, :-5].std() > 0.05
    assert torch.allclose(moved[:-3, 5:], there[3:, :-5], atol=1e-3)


@pytest.mark.parametrize("where", ["nowhere", "everywhere", "corner", "one pixel"])
def test_defect_12_a_patch_is_cut_wherever_the_person_is(where):
    mask = torch.zeros(50, 300)
    mask[{"nowhere": [], "everywhere": slice(None), "corner": slice(-3, None), "one pixel": [49]}[where], -1] = 1
    rows, columns = losses.random_patch(mask, SIDE, torch.Generator().manual_seed(0))
    assert mask[rows, columns].shape == (50, SIDE)


def test_defect_13_lpips_takes_the_range_it_was_made_for_and_the_other_by_name():
    lpips = Lpips(small_weights("alex"), torch.float64)
    a, b = torch.rand(2, 71, 83, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert lpips(a, b, legacy=True) == pytest.approx(lpips((a + 1) / 2, (b + 1) / 2).item(), rel=1e-12)
    assert abs(lpips(a, b, legacy=True) - lpips(a, b)) > 0.1 * lpips(a, b)


@pytest.mark.slow
def test_defect_14_training_settles(clip, monkeypatch):
    grown = []
    for name in ("grow_human", "grow_scene"):
        real = getattr(densify, name)
        monkeypatch.setattr(densify, name, lambda *a, real=real: (grown.append(fit.progress.done), real(*a))[1])
    fit = fit_of(clip)
    run(fit, 40)
    assert grown and max(grown) <= SETTLE < 0.8
    for name in LR_HUMAN | LR_SCENE | LR_OWN | LR_FRAMES:
        steps = [rate(name, done) for done in torch.linspace(SETTLE, 1, 20).tolist()]
        assert steps == sorted(steps, reverse=True) and steps[-1] <= 0.1 + 1e-9 and math.isclose(rate(name, 0), 1)

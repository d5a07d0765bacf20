import io

import numpy as np
import pytest
import torch
import trimesh

from stages.avatar.compose import compose
from stages.avatar.fit import Fit
from stages.avatar.gaussians import Splats
from stages.avatar.human import HumanModel, bone_transforms, pose, rest
from stages.avatar.layers import veil
from stages.avatar.refine import spread
from stages.avatar.scene import SceneModel
from stages.avatar.schedule import Options
from stages.avatar.views import Person, Views, person_box

WIDTH, HEIGHT, FRAMES = 48, 40, 6
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]


def ellipsoid():
    mesh = trimesh.creation.icosphere(2, 0.4)
    vertices = torch.tensor(mesh.vertices * [0.6, 1.6, 0.5], dtype=torch.float32)
    weights = torch.zeros(len(vertices), 24)
    weights[:, 3] = torch.sigmoid(vertices[:, 1] / 0.05)
    weights[:, 0] = 1 - weights[:, 3]
    return vertices, torch.tensor(np.array(mesh.faces)).long(), weights


def models(seed: int = 1, **more):
    generator = torch.Generator().manual_seed(seed)
    sizes = {"rounds": 0, "channels": 8, "resolution": 24, "sh_degree": 0} | more
    human = HumanModel(*ellipsoid(), **sizes, generator=generator)
    wall = torch.rand(150, 3, generator=generator) * torch.tensor([4.0, 3, 0.2]) - torch.tensor([2, 1.5, -1])
    return human, SceneModel(wall, torch.full((150, 3), 0.5), 1, 1.0), generator


def make_clip():
    """A bending, striped ellipsoid before a speckled wall, and its true poses."""
    vertices, _, weights = ellipsoid()
    viewmats = torch.eye(4).repeat(FRAMES, 1, 1)
    viewmats[:, 2, 3] = 3
    viewmats[:, 0, 3] = torch.linspace(-0.4, 0.4, FRAMES)
    Ks = torch.tensor([[50.0, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]]).repeat(FRAMES, 1, 1)
    body_pose = torch.zeros(FRAMES, 69)
    body_pose[:, 8] = torch.linspace(-0.5, 0.5, FRAMES)
    still, joints = torch.zeros(FRAMES, 3), torch.zeros(24, 3)
    confidence = torch.ones(FRAMES)
    person = Person(
        still, body_pose, still, confidence, joints, PARENTS, torch.zeros(69), vertices, weights, ellipsoid()[1]
    )
    human, scene, generator = models(0)
    scene.sh0.data = torch.randn(scene.sh0.shape, generator=generator)
    scene.logit_opacities.data[:] = 3
    scene.log_scales.data += 1
    images, masks = [], []
    with torch.no_grad():
        canonical = human()[0]._replace(sh=torch.sin(8 * vertices)[:, None] * 1.5)
        resting = rest(canonical, bone_transforms(joints, PARENTS, torch.zeros(3), torch.zeros(69)))
        for f in range(FRAMES):
            splats = pose(resting, bone_transforms(joints, PARENTS, still[f], body_pose[f]), still[f])
            drawn = compose(splats, scene.splats(), viewmats[f], Ks[f], WIDTH, HEIGHT)
            images.append((drawn.image.clamp(0, 1) * 255).round().byte())
            masks.append((compose(splats, None, viewmats[f], Ks[f], WIDTH, HEIGHT).alpha * 255).round().byte())
    return Views(torch.stack(images), torch.stack(masks), viewmats, Ks), person


clip = pytest.fixture(scope="module")(make_clip)


def fit_of(clip, steps: int = 40, scene: bool = True, **more) -> Fit:
    views, person = clip
    human, wall, generator = models()
    options = Options(steps, 2, 300, 260, 1.0, exposure=True, growth_rounds=4)._replace(**more)
    return Fit(views, [0, 1, 3, 4, 5], person, human, wall if scene else None, options, generator)


def run(fit: Fit, until: int) -> list[float]:
    return [sum(fit.advance().values()) for _ in range(until - fit.step)]


def test_it_learns_and_both_sets_grow_to_their_caps(clip):
    fit = fit_of(clip, steps=80)
    numbers = run(fit, 80)
    assert np.mean(numbers[-10:]) < 0.8 * np.mean(numbers[:10])
    assert len(fit.human) <= 300 and len(fit.scene) <= 260
    assert len(fit.human) > 162 and len(fit.scene) > 150 and fit.bad == 0


def test_resumed_equals_uninterrupted_bit_for_bit(clip):
    straight, first = fit_of(clip), fit_of(clip)
    run(straight, 40)
    run(first, 14)
    file = io.BytesIO()
    torch.save(first.state(), file)
    file.seek(0)
    second = fit_of(clip)
    second.load(torch.load(file, weights_only=True))
    assert len(second.scene) > 150, "a densification must lie before the break"
    size = len(second.human)
    run(second, 40)
    assert len(second.human) > size, "and one behind it"
    for name, module in straight._modules().items():
        for key, value in module.state_dict().items():
            assert torch.equal(value, second._modules()[name].state_dict()[key]), (name, key)


def test_what_no_frame_shows_is_kept_as_it_began(clip):
    fit = fit_of(clip, steps=80)
    run(fit, 10)
    hidden = torch.arange(len(fit.human)) < 5
    fit.taught[hidden] = 0  # as if behind all others
    kept, decoded, began = fit.baked()[0], fit.human()[0], fit.human.untaught()
    assert (fit.taught[~hidden] > 0).float().mean() > 0.5, "most are seen"
    for part, b in zip(kept, began, strict=True):
        assert torch.equal(part[hidden], b[hidden])
    seen = fit.taught > 0.1 * fit.taught.mean()
    assert torch.equal(kept.means[seen], decoded.means[seen])
    assert not torch.equal(decoded.means[hidden], began.means[hidden])
    run(fit, 80)
    assert len(fit.taught) == len(fit.human) == len(fit.human.homes) > 162, "rows follow growth"
    assert (fit.human.homes - fit.human.xyz).norm(dim=1).max() < 0.1


def test_a_checkpoint_between_decodes_is_refused(clip):
    fit = fit_of(clip)
    fit.advance()
    with pytest.raises(RuntimeError, match="between two decodes"):
        fit.state()


def test_a_checkpoint_of_another_model_is_refused(clip):
    state = fit_of(clip).state()
    state["models"]["human"]["triplane.table"] = torch.zeros(3, 3)
    with pytest.raises(RuntimeError, match=r"triplane\.table"):
        fit_of(clip).load(state)


@pytest.mark.parametrize(
    "case", ["empty masks", "person out of frame", "person behind the camera", "no fit", "no scene"]
)
def test_frames_without_a_person_to_learn_from_stay_finite(clip, case):
    views, person = clip
    if case == "empty masks":
        views = views._replace(masks=torch.zeros_like(views.masks))
    if case == "person out of frame":
        person = person._replace(transl=person.transl + torch.tensor([50.0, 0, 0]))
    if case == "person behind the camera":
        person = person._replace(transl=person.transl - torch.tensor([0, 0, 20.0]))
    if case == "no fit":
        person = person._replace(confidence=torch.zeros(FRAMES))
    fit = fit_of((views, person), scene=case != "no scene")
    before = fit.human.xyz.detach().clone()
    run(fit, 6)
    assert fit.bad == 0
    assert all(p.isfinite().all() for module in fit._modules().values() for p in module.parameters())
    if case in ("empty masks", "no fit"):
        assert torch.equal(before, fit.human.xyz)


def test_a_doubtful_pose_teaches_as_little_as_it_is_trusted(clip):
    views, person = clip
    sure, doubtful = fit_of(clip), fit_of((views, person._replace(confidence=torch.full((FRAMES,), 0.25))))
    for fit in (sure, doubtful):
        run(fit, 1)
    assert sure.leaves.sh.grad.abs().max() > 0
    torch.testing.assert_close(doubtful.leaves.sh.grad, 0.25 * sure.leaves.sh.grad)
    assert torch.equal(sure.scene.sh0, doubtful.scene.sh0), "the scene learns as ever"


def test_a_gradient_that_is_not_finite_stays_in_its_row(clip):
    fit, clean = fit_of(clip), fit_of(clip)
    fit.scene.means.register_hook(lambda g: g.index_fill(0, torch.tensor([7]), float("nan")))
    run(fit, 1)
    run(clean, 1)
    others = torch.arange(150) != 7
    assert fit.bad == 1
    assert torch.equal(fit.scene.means[others], clean.scene.means[others]) and fit.scene.means.isfinite().all()


def test_a_colour_gradient_that_is_not_finite_teaches_nothing(clip):
    fit = fit_of(clip)
    fit.resting().sh.register_hook(lambda g: g.index_fill(0, torch.tensor([7]), float("nan")))
    run(fit, 2)
    assert fit.bad == 1 and fit.taught.isfinite().all() and fit.taught[7] == 0 and fit.taught.max() > 0


def test_a_gaussian_that_is_not_finite_is_not_drawn_and_counted(clip):
    fit = fit_of(clip)
    run(fit, 2)
    assert fit.undrawn == 0
    with torch.no_grad():
        fit.scene.means[7] = torch.nan
    run(fit, 4)
    assert fit.undrawn == 2 and fit.state()["numbers"][3] == 2


def test_a_loss_that_is_never_finite_stops_training(clip):
    fit = fit_of(clip)
    with torch.no_grad():
        fit.frames.gain.weight.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="20 steps in a row"):
        run(fit, 40)


def test_one_enormous_gradient_does_not_freeze_the_networks(clip):
    fit = fit_of(clip, steps=400)
    run(fit, 20)
    usual = fit.usual_norm
    fit.resting()
    fit.leaves.sh.register_hook(lambda g: g * 1e12)
    run(fit, 22)
    table = fit.human.triplane.table
    moments = fit.adam["human"].state[table]
    assert moments["exp_avg_sq"].max() < (100 * usual) ** 2


def test_only_seen_frames_move_and_others_take_their_neighbours(clip):
    fit = fit_of(clip)
    run(fit, 12)
    assert (fit.frames.pose.weight[2] == 0).all() and fit.frames.pose.weight[1].abs().sum() > 0
    orient = fit.bodies()[0]
    assert torch.allclose(orient[2], (orient[1] + orient[3]) / 2, atol=1e-6)
    assert torch.allclose(fit.gains()[fit.train].log().mean(0), torch.zeros(3), atol=1e-6)


def test_spread_is_linear_between_and_constant_beyond():
    table = torch.tensor([[9.0], [1.0], [9.0], [9.0], [4.0], [9.0]])
    trained = torch.tensor([False, True, False, False, True, False])
    assert spread(table, trained)[:, 0].tolist() == [1, 1, 2, 3, 4, 4]
    assert spread(table, torch.zeros(6, dtype=torch.bool)).abs().sum() == 0
    moments = torch.tensor([0, 1, 1, 2, 4, 4])
    assert spread(table, trained, moments)[:, 0].tolist() == [1, 1, 1, 2, 4, 4], "pictures of one moment share"


def test_a_crop_draws_the_same_pixels(clip):
    views = clip[0]
    human, _, _ = models()
    resting = rest(human()[0].__class__(*(t.detach() for t in human()[0])), torch.eye(4).repeat(24, 1, 1))
    splats = pose(resting, torch.eye(4).repeat(24, 1, 1), torch.zeros(3))
    mask = views.masks[0].float() / 255
    left, top, right, bottom = person_box(mask, splats.means, views.viewmats[0], views.Ks[0])
    assert (right - left) * (bottom - top) < WIDTH * HEIGHT
    K = views.Ks[0].clone()
    whole = compose(splats, None, views.viewmats[0], K, WIDTH, HEIGHT).image[top:bottom, left:right]
    K[:2, 2] -= torch.tensor([left, top])
    part = compose(splats, None, views.viewmats[0], K, right - left, bottom - top).image
    assert torch.allclose(whole, part, atol=1e-5)


def test_person_box_is_always_a_window_of_the_picture():
    K = torch.tensor([[50.0, 0, 24], [0, 50, 20], [0, 0, 1]])
    empty, view = torch.zeros(HEIGHT, WIDTH), torch.eye(4)
    assert person_box(empty, torch.zeros(0, 3), view, K) == (0, 0, WIDTH, HEIGHT)
    for x in (-1000.0, 0.0, 1000.0):
        left, top, right, bottom = person_box(empty, torch.tensor([[x, x, 2.0]]), view, K)
        assert 0 <= left < right <= WIDTH and 0 <= top < bottom <= HEIGHT


def test_veil_is_what_stands_before_the_person():
    depths = torch.tensor([1.0, 2.9, 3.5, 6.0])
    scene = Splats(
        torch.stack([0 * depths, 0 * depths, depths], 1), torch.eye(3).repeat(4, 1, 1), depths, depths[:, None]
    )
    person = torch.tensor([[0, 0, 2.8], [0, 0, 3.0], [0, 0, 3.2]]).repeat(10, 1)
    assert scene.opacities[veil(scene, person, torch.eye(4))].tolist() == pytest.approx([1.0, 2.9])
    assert not veil(scene, person + torch.tensor([0, 0, -5.0]), torch.eye(4)).any()

"""The training loop: it learns, resumes bit for bit, and survives bad rows, gradients and frames."""

import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch

from stages.avatar.model.person import pose, rest
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.training.step.fit import Fit
from stages.training.step.layers import foreground_occluders
from stages.training.step.person import Starting
from stages.training.step.refine import spread
from stages.training.views import Views, person_box
from tests.made.learned import compose
from tests.made.training import FRAMES, HEIGHT, TRAIN, WIDTH, fit_of, make_clip, models, run, same, settings, stored

clip = pytest.fixture(scope="module")(make_clip)


@pytest.mark.slow
def test_it_learns_and_both_sets_grow_to_their_caps(clip):
    fit = fit_of(clip, steps=60)
    numbers = run(fit, 60)
    assert np.mean(numbers[-10:]) < 0.8 * np.mean(numbers[:10])
    assert len(fit.people[0].human) <= 300 and len(fit.scene) <= 260
    assert len(fit.people[0].human) > 162 and len(fit.scene) > 150 and fit.guard.left_out == 0


@pytest.mark.slow
def test_h11_resumed_equals_uninterrupted_bit_for_bit(clip):
    straight, first = fit_of(clip), fit_of(clip)
    run(straight, 40)
    for broken_at in (14, 17, 33):  # 33: networks rest
        run(first, broken_at)
        waiting = first.people[0].leaves is not None
        assert waiting == (broken_at != 14), "17: between two decodes, with gradients waiting"
        second = fit_of(clip)
        second.load(stored(first))
        assert len(second.scene) > 150, "a densification must lie before the break"
        size = len(second.people[0].human)
        run(second, 40)
        assert broken_at == 33 or len(second.people[0].human) > size, "and one behind it"
        assert same(straight, second)


@pytest.mark.slow
@pytest.mark.parametrize("triplane", [True, False])
def test_networks_rest_in_the_end_and_own_corrections_go_on(clip, triplane):
    fit = fit_of(clip, triplane=triplane, networks_until=0.5)
    run(fit, 21)
    human, own = fit.people[0].human, {id(p) for p in fit.people[0].human.residuals.parameters()}
    before = {name: p.clone() for name, p in human.named_parameters()}
    run(fit, 30)
    moved = {name: not torch.equal(p, before[name]) for name, p in human.named_parameters() if p.requires_grad}
    corrections = {name for name, p in human.named_parameters() if id(p) in own}
    assert all(moved[name] for name in corrections if name.endswith(("turn", "scale", "opacity", "sh")))
    shared = [moved[name] for name in moved if name not in corrections]
    assert any(shared) != triplane, "without a triplane all a Gaussian has is its own"


@pytest.mark.slow
def test_h12_the_same_seed_gives_the_same_bits_and_another_gives_others(clip):
    first, second, other = fit_of(clip), fit_of(clip), fit_of(clip)
    other.generator.manual_seed(7)
    for fit in (first, second, other):
        run(fit, 20)
    assert len(first.scene) > 150, "growth draws random numbers too"
    assert same(first, second) and not same(first, other)


@pytest.mark.slow
def test_what_no_frame_shows_is_kept_as_it_began(clip):
    fit = fit_of(clip)
    run(fit, 10)
    hidden = torch.arange(len(fit.people[0].human)) < 5
    fit.people[0].color_grad_sum[hidden] = 0  # as if behind all others
    kept, decoded, began = fit.people[0].baked()[0], fit.people[0].human()[0], fit.people[0].human.initial()
    assert (fit.people[0].color_grad_sum[~hidden] > 0).float().mean() > 0.5, "most are seen"
    for part, b in zip(kept, began, strict=True):
        assert torch.equal(part[hidden], b[hidden])
    seen = fit.people[0].color_grad_sum > 0.1 * fit.people[0].color_grad_sum.mean()
    assert torch.equal(kept.means[seen], decoded.means[seen])
    assert not torch.equal(decoded.means[hidden], began.means[hidden])
    run(fit, 40)
    assert len(fit.people[0].color_grad_sum) == len(fit.people[0].human) == len(fit.people[0].human.homes) > 162, (
        "rows follow growth"
    )
    assert (fit.people[0].human.homes - fit.people[0].human.xyz).norm(dim=1).max() < 0.1


def test_h13_a_checkpoint_of_another_model_is_refused(clip):
    state = fit_of(clip).state()
    state["models"]["person 1"]["triplane.table"] = torch.zeros(3, 3)
    with pytest.raises(RuntimeError, match=r"triplane\.table"):
        fit_of(clip).load(state)


@pytest.mark.parametrize(
    "case", ["empty masks", "person out of frame", "person behind the camera", "no fit", "no scene"]
)
def test_g06_frames_without_a_person_to_learn_from_stay_finite(clip, case):
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
    before = fit.people[0].human.xyz.detach().clone()
    run(fit, 6)
    assert fit.guard.left_out == 0
    assert all(p.isfinite().all() for module in fit.modules().values() for p in module.parameters())
    if case in ("empty masks", "no fit"):
        assert torch.equal(before, fit.people[0].human.xyz)


def test_a_doubtful_pose_teaches_as_little_as_it_is_trusted(clip):
    views, person = clip
    sure, doubtful = fit_of(clip), fit_of((views, person._replace(confidence=torch.full((FRAMES,), 0.25))))
    for fit in (sure, doubtful):
        run(fit, 1)
    assert sure.people[0].leaves["sh"].grad.abs().max() > 0
    torch.testing.assert_close(doubtful.people[0].leaves["sh"].grad, 0.25 * sure.people[0].leaves["sh"].grad)
    assert torch.equal(sure.scene.sh0, doubtful.scene.sh0), "the scene learns as ever"


def spoil(fit: Fit, part: str, wrong: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """Make the gradients of a part of the person at rest wrong from now on."""
    resting = fit.people[0].resting
    fit.people[0].resting = lambda learn: (r := resting(learn), getattr(r, part).register_hook(wrong))[0]


def poisoned(fit: Fit, tensor: torch.Tensor, row: int, by: float) -> None:
    """One step in which the gradient of one row of `tensor` is multiplied by `by` (NaN, infinite, or enormous)."""
    hook = tensor.register_hook(lambda g: torch.cat([g[:row], g[row : row + 1] * by, g[row + 1 :]]))
    fit.advance()
    hook.remove()


@pytest.mark.slow
@pytest.mark.parametrize(("by", "begun"), [(float("nan"), 5), (1e12, 0), (1e12, 1), (1e12, 21)])
def test_h01_h02_a_bad_gradient_stays_in_its_row_and_is_forgotten(clip, by, begun):
    fit, clean = fit_of(clip, steps=400), fit_of(clip, steps=400)
    for f in (fit, clean):
        run(f, begun)
        f.advance() if f is clean else poisoned(f, f.scene.means, 7, by)
    others = torch.arange(150) != 7
    assert fit.guard.left_out == 1 and clean.guard.left_out == 0
    assert torch.equal(fit.scene.means[others], clean.scene.means[others])
    assert not torch.equal(fit.scene.means[7], clean.scene.means[7]), "the gradient was not zero"
    run(fit, begun + 11)
    moments = fit.adam["scene"].state[fit.scene.means]
    assert fit.guard.left_out == 1 and all(p.isfinite().all() for p in fit.scene.parameters())
    assert moments["exp_avg_sq"].isfinite().all() and moments["exp_avg_sq"][7].max() < 10 * moments["exp_avg_sq"].max()


@pytest.mark.parametrize("by", [float("nan"), 1e12])
def test_c09_h01_h02_a_bad_row_of_the_person_never_reaches_the_networks(clip, by):
    fit, silent = fit_of(clip, steps=400), fit_of(clip, steps=400)
    for f in (fit, silent):
        run(f, 6)
    spoil_row(fit, "means", by, 40)
    for name, leaf in silent.people[0]._decoded().items():
        if leaf.requires_grad:
            spoil_row(silent, name, 0.0, 40)
    for f in (fit, silent):
        run(f, 8)
    assert fit.guard.left_out == 1 and silent.guard.left_out == 0
    for name, value in fit.people[0].human.state_dict().items():
        assert torch.equal(value, silent.people[0].human.state_dict()[name]), name


def spoil_row(fit: Fit, name: str, by: float, row: int) -> None:
    """Multiply the gradient that a row of a leaf gets of each frame until the networks learn."""
    fit.people[0]._decoded()[name].register_hook(lambda g: torch.cat([g[:row], g[row : row + 1] * by, g[row + 1 :]]))


@pytest.mark.parametrize(("by", "begun"), [(float("nan"), 10), (1e12, 0), (1e12, 10)])
def test_h01_h02_a_bad_gradient_of_a_frame_does_not_stay_with_it(clip, by, begun):
    fit = fit_of(clip, steps=400)
    run(fit, begun)
    hook = fit.people[0].corrections.pose.weight.register_hook(lambda g: g * by)
    fit.advance()
    hook.remove()
    assert fit.guard.left_out == 1
    moments = fit.adam["frames of person 1"].state[fit.people[0].corrections.pose.weight]
    assert fit.people[0].corrections.pose.weight.isfinite().all() and moments["exp_avg_sq"].isfinite().all()
    assert moments["exp_avg_sq"].max() < 1


def test_h01_a_colour_gradient_that_is_not_finite_teaches_nothing(clip):
    fit = fit_of(clip)
    spoil(fit, "sh", lambda g: g.index_fill(0, torch.tensor([7]), float("nan")))
    run(fit, 2)
    assert (
        fit.guard.left_out == 3  # of its own in two frames, and the networks'
        and fit.people[0].color_grad_sum.isfinite().all()
        and fit.people[0].color_grad_sum[7] == 0
        and fit.people[0].color_grad_sum.max() > 0
    )


def test_a23_h01_a_gaussian_that_is_not_finite_is_not_drawn_and_counted(clip):
    fit = fit_of(clip)
    run(fit, 2)
    assert fit.undrawn == 0
    with torch.no_grad():
        fit.scene.means[7] = torch.nan
    run(fit, 4)
    assert fit.undrawn == 2 and fit.state()["progress"]["step"] == 4


@pytest.mark.parametrize(
    ("what", "part"), [("loss", ""), ("scene", "sh"), ("corrections of person 1", "sh"), ("person 1", "means")]
)
def test_h01_too_many_bad_steps_stop_training_and_the_last_can_be_taken_again(clip, monkeypatch, what, part):
    monkeypatch.setattr("stages.training.step.guard.BAD_STEPS", 5)
    fit = fit_of(clip, steps=400)
    run(fit, 3)

    def broken(f: Fit) -> None:
        if what == "loss":
            f.frames.gain.weight.data.fill_(torch.nan)
        elif what == "scene":
            f.scene.sh0.register_hook(lambda g: torch.full_like(g, torch.nan))
        else:
            spoil(f, part, lambda g: torch.full_like(g, torch.nan))

    broken(fit)
    with pytest.raises(FloatingPointError, match=f"5 bad steps in a row, {what}") as error:
        run(fit, 100)
    if what != "loss":
        assert f"the first in {what}.{part}" in str(error.value) and "row 0" in str(error.value)
    failed_at = fit.before["progress"]["step"]
    assert 7 <= failed_at <= 13 and fit.guard.left_out >= 5
    again = fit_of(clip, steps=400)
    again.load(fit.before)
    if what != "loss":
        broken(again)
    with pytest.raises(FloatingPointError) as repeated:
        again.advance()
    assert str(repeated.value) == str(error.value) and again.frame == fit.frame


def test_h01_a_single_row_that_is_always_bad_does_not_stop_training(clip, monkeypatch):
    monkeypatch.setattr("stages.training.step.guard.BAD_STEPS", 5)
    fit = fit_of(clip, steps=400)
    fit.scene.means.register_hook(lambda g: g.index_fill(0, torch.tensor([7]), float("nan")))
    run(fit, 7)
    assert fit.guard.left_out == 7 and fit.scene.means.isfinite().all()


def test_h05_all_gaussians_pruned_stops_with_the_reasons(clip):
    fit = fit_of(clip, steps=40)
    with torch.no_grad():
        fit.scene.logit_opacities.fill_(-20)
    with pytest.raises(ValueError, match=r"all 150 Gaussians would be pruned: 150 with opacity under 0.005"):
        run(fit, 40)
    assert len(fit.scene) == 150, "nothing was changed"


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 2)])
def test_b10_g04_pictures_of_a_few_pixels_train(clip, size):
    views, person = clip
    height, width = size
    Ks = views.Ks.clone()
    Ks[:, 0, 2], Ks[:, 1, 2] = width / 2, height / 2
    pictures = torch.full((FRAMES, height, width, 3), 90, dtype=torch.uint8)
    fit = fit_of((Views(pictures, torch.full((FRAMES, height, width), 255).byte(), views.viewmats, Ks), person), 6)
    before = fit.people[0].human.xyz.detach().clone()
    run(fit, 6)
    assert all(p.isfinite().all() for module in fit.modules().values() for p in module.parameters())
    assert not torch.equal(before, fit.people[0].human.xyz) and fit.guard.left_out == 0


@pytest.mark.slow
def test_h19_one_frame_trains(clip):
    views, person = clip
    one = Views(*(part[:1] for part in views[:4]))
    alone = person._replace(
        **{n: getattr(person, n)[:1] for n in ("global_orient", "body_pose", "transl", "confidence")}
    )
    human, wall, generator = models()
    fit = Fit(one, [0], [Starting(alone, human)], wall, *settings(60, growth_rounds=20), generator)
    numbers = run(fit, 60)
    assert fit.guard.left_out == 0 and np.mean(numbers[-10:]) < 0.95 * np.mean(numbers[25:35]), "at one resolution"
    assert fit.poses(fit.people[0])[0].shape == (1, 3) and fit.gains().tolist() == [[1, 1, 1]]


HALVED = """
import resource, torch
from stages.training.views import Views
images, masks = torch.zeros(1300, 96, 64, 3).byte(), torch.zeros(1300, 96, 64).byte()
views = Views(images, masks, torch.eye(4).repeat(1300, 1, 1), torch.eye(3).repeat(1300, 1, 1))
views._replace(images=images[:2], masks=masks[:2]).half()
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
views.half()
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / (images.numel() + masks.numel()))
"""


@pytest.mark.slow
def test_a_clip_of_1300_frames_is_halved_frame_by_frame_and_trains(clip, held):
    done = subprocess.run([sys.executable, "-c", HALVED], capture_output=True, text=True, check=True)
    held(float(done.stdout), 0.75, "memory over that of the pictures")
    (views, person), many = clip, 1300
    of = torch.arange(many) % FRAMES
    long = Views(*(part[of] for part in views[:4]))
    moved = person._replace(
        **{n: getattr(person, n)[of] for n in ("global_orient", "body_pose", "transl", "confidence")}
    )
    human, wall, generator = models()
    fit = Fit(long, list(range(many)), [Starting(moved, human)], wall, *settings(6, growth_rounds=20), generator)
    run(fit, 6)
    assert (
        fit.guard.left_out == 0
        and fit.poses(fit.people[0])[0].shape == (many, 3)
        and fit.poses(fit.people[0])[0].isfinite().all()
    )


def test_only_seen_frames_move_and_others_take_their_neighbours(clip):
    fit = fit_of(clip)
    run(fit, 12)
    assert (fit.people[0].corrections.pose.weight[2] == 0).all() and fit.people[0].corrections.pose.weight[
        1
    ].abs().sum() > 0
    orient = fit.poses(fit.people[0])[0]
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
    whole = compose(splats, None, Camera(views.viewmats[0], K, WIDTH, HEIGHT))[0].image[top:bottom, left:right]
    K[:2, 2] -= torch.tensor([left, top])
    part = compose(splats, None, Camera(views.viewmats[0], K, right - left, bottom - top))[0].image
    assert torch.allclose(whole, part, atol=1e-5)


def test_person_box_is_always_a_window_of_the_picture():
    K = torch.tensor([[50.0, 0, 24], [0, 50, 20], [0, 0, 1]])
    empty, view = torch.zeros(HEIGHT, WIDTH), torch.eye(4)
    assert person_box(empty, torch.zeros(0, 3), view, K) == (0, 0, WIDTH, HEIGHT)
    for x in (-1000.0, 0.0, 1000.0):
        left, top, right, bottom = person_box(empty, torch.tensor([[x, x, 2.0]]), view, K)
        assert 0 <= left < right <= WIDTH and 0 <= top < bottom <= HEIGHT


@pytest.mark.slow
def test_the_exposure_of_a_frame_is_met_by_its_gain_in_a_few_looks(clip):
    views, person = clip
    images = views.images.clone()
    images[3] = (0.85 * images[3]).byte()
    fit = fit_of((views._replace(images=images), person), steps=100)
    run(fit, 100)
    gains = fit.gains().mean(1)
    assert 0.8 < gains[3] / gains[[0, 1, 4, 5]].mean() < 0.92
    assert gains[[0, 1, 4, 5]].min() / gains[[0, 1, 4, 5]].max() > 0.94


def test_occluders_are_what_stands_before_the_person_as_far_as_each_pixel_shows_them():
    depths = torch.tensor([1.0, 2.7, 2.9, 6.0, 1.9, 2.5, 2.9])
    at = torch.tensor([0, 0, 0, 0, 0.8, -0.4, 0.8])  # as x / z: before the body, the hand's height, then beside both
    means = torch.stack([at * depths, 0 * depths, depths], 1)
    scene = Splats(means, torch.eye(3).repeat(7, 1, 1), depths, depths[:, None])
    body = torch.tensor([[0, 0, 2.8], [0, 0, 3.0], [0, 0, 3.2], [0.8 * 2.4, 0, 2.4]])
    view = torch.eye(4), torch.tensor([[20.0, 0, 24], [0, 20, 20], [0, 0, 1]]), WIDTH, HEIGHT
    kept = scene.opacities[foreground_occluders(scene, body, *view)]
    assert kept.tolist() == pytest.approx([1.0, 2.7, 1.9]), (
        "2.9 is under the body's skin, or behind the hand; 2.5 beside"
    )
    assert not foreground_occluders(scene, body + torch.tensor([0, 0, -5.0]), *view).any()


def test_every_training_frame_is_seen_once_in_each_round_and_no_other(clip):
    fit = fit_of(clip)
    rounds = [[fit._next_frame() for _ in TRAIN] for _ in range(5)]
    assert all(sorted(seen) == sorted(TRAIN) for seen in rounds) and len(TRAIN) < FRAMES
    assert len({tuple(seen) for seen in rounds}) > 1, "each time in another order"


def test_what_is_learned_of_poses_is_written_with_its_sign(clip):
    """What a frame is drawn with in training is what is written for it afterwards."""
    fit, body = fit_of(clip, refine_pose=True), clip[1]
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for table in (fit.people[0].corrections.pose, fit.people[0].corrections.place):
            table.weight.copy_(torch.randn(table.weight.shape, generator=generator))
        written = fit.poses(fit.people[0])
        for frame in TRAIN:
            for part, drawn in zip(written[:3], fit.pose(fit.people[0], frame)[:3], strict=True):
                torch.testing.assert_close(part[frame], drawn)
            torch.testing.assert_close(
                written[2][frame], body.transl[frame] + fit.people[0].corrections.place.weight[frame]
            )
            torch.testing.assert_close(
                written[0][frame], body.global_orient[frame] + fit.people[0].corrections.pose.weight[frame, :3]
            )

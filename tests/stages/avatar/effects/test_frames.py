"""Effects in a training: off they are not there, on they are learned, kept in checkpoints, and drawn the same later."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from stages.avatar.cameras.pinhole import pinhole
from stages.avatar.drawing.avatar import PosedAvatar
from stages.avatar.drawing.cast import Cast, Moment
from stages.avatar.effects.camera_refinement import correct_cameras
from stages.avatar.effects.frames import FrameEffects, load_effects
from stages.avatar.effects.shadow import Shadow, casters
from stages.avatar.effects.speeds import Speeds
from stages.avatar.rasterize import Camera, Layer
from stages.avatar.splats.compose import draw_together
from stages.avatar.splats.gaussians import Splats
from stages.formats.body_model import read_body_model
from stages.records import Effects
from stages.training.step.fit import Fit
from stages.training.step.person import Starting
from stages.training.step.refine import FrameCorrections, agreement
from stages.training.timing.accuracy import heldout_accuracy
from tests.made import tiny
from tests.made.learned import draw, load_learned
from tests.made.training import HEIGHT, TRAIN, WIDTH, fit_of, make_clip, models, run, same, settings, stored

UP = torch.tensor([0.0, -0.6, -0.8])  # the wall is behind the person, and takes the shadow
clip = pytest.fixture(scope="module")(make_clip)


def fit_with(clip, effects: FrameEffects, steps: int = 40, **more) -> Fit:
    views, person = clip
    human, wall, generator = models()
    return Fit(views, TRAIN, [Starting(person, human)], wall, *settings(steps, **more), generator, effects=effects)


def everything() -> FrameEffects:
    return FrameEffects.starting(UP, shadow=0.5, motion_blur=True, rolling_shutter=True)


def test_off_is_bit_identical_and_draws_through_nothing(clip, monkeypatch):
    plain = fit_of(clip, exposure=False)
    off = fit_with(clip, FrameEffects.starting(UP, shadow=None, motion_blur=False, rolling_shutter=False))
    run(plain, 6), run(off, 6)
    assert same(plain, off) and not off.effects.known() and "effects" not in off.adam
    assert off.cameras() is off.full.viewmats and off.speeds is None and off.cast().at(1).motion is None
    on = fit_with(clip, everything(), refine_camera=True)
    run(on, 6)
    assert not torch.equal(on.scene.sh0, off.scene.sh0)
    seen = []
    monkeypatch.setattr("stages.avatar.effects.frames.draw_together", lambda *a: seen.append(a) or draw_together(*a))
    scene, camera = off.scene.splats(), Camera(off.full.viewmats[0], off.full.Ks[0], WIDTH, HEIGHT)
    moment = Cast(off.cast().people, scene, FrameEffects()).at(0)
    Moment((), moment.scene).draw(camera)
    assert len(seen) == 1 and seen[0][0][0] is scene is moment.scene


@pytest.mark.slow
def test_a_training_with_all_effects_goes_on_from_a_checkpoint_to_the_bit(clip, monkeypatch):
    monkeypatch.setattr("stages.avatar.effects.motion_blur.LENGTHS", (0.0, 0.0))  # here all blur is under a pixel
    whole, first = (fit_with(clip, everything(), refine_camera=True) for _ in range(2))
    run(whole, 12), run(first, 7)
    second = fit_with(clip, everything(), refine_camera=True)
    second.load(stored(first))
    run(second, 12)
    assert same(whole, second) and whole.guard.left_out == 0
    start = everything().state_dict()
    for name, value in whole.effects.state_dict().items():
        assert value.isfinite().all() and (name == "shadow.frame" or not torch.equal(value, start[name])), name
    assert set(heldout_accuracy(whole.cast(), whole.seen(), [2])) == set(
        heldout_accuracy(whole.cast(), whole.seen(), [])
    )


def test_what_is_known_is_drawn_the_same_when_it_is_read(clip):
    fit = fit_with(clip, everything())
    run(fit, 6)
    read = load_effects(Effects(**fit.effects.known()))
    assert not any(p.requires_grad for p in read.parameters())
    pictures, camera = [], Camera(fit.full.viewmats[1], fit.full.Ks[1], WIDTH, HEIGHT)
    with torch.no_grad():
        for effects in (fit.effects, read, FrameEffects()):
            pictures.append(fit.cast()._replace(effects=effects).at(1).draw(camera)[0].image)
    torch.testing.assert_close(pictures[0], pictures[1], atol=1e-5, rtol=0)
    assert (pictures[0] - pictures[2]).abs().max() > 0.01
    assert load_effects(Effects()).known() == {}


def test_times_stay_within_a_moment():
    effects = FrameEffects(shutter=0.5, readout=0.0)
    effects.shutter.data[:], effects.readout.data[:] = -3, -3
    effects.clamp_times()
    assert effects.known() == {"shutter": 0.0, "readout": -1.0}


def moving_wall(readout: float, shutter: float, count: int = 6) -> tuple[FrameEffects, list, Splats]:
    """Pictures of a wall from a camera that turns and slides, as effects of that strength draw them, and the effects."""
    g = torch.Generator().manual_seed(3)
    means = torch.rand(300, 3, generator=g) * torch.tensor([4.0, 3, 0.2]) - torch.tensor([2, 1.5, -1])
    axes = 0.06 * torch.eye(3).expand(300, 3, 3)
    scene = Splats(means, axes, torch.full((300,), 0.95), torch.randn(300, 1, 3, generator=g))
    twist = np.zeros((4, 4))
    twist[:3] = [[0, 0, 0.05, 0.1], [0, 0, 0.06, -0.08], [-0.05, -0.06, 0, 0.0]]
    start = np.eye(4)
    start[2, 3] = 3
    viewmats = np.stack([expm(t * twist) @ start for t in range(count)])
    Ks = torch.tensor([[50.0, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]]).expand(count, 3, 3)
    speeds = Speeds(viewmats, Ks, HEIGHT, np.arange(count))
    truth = FrameEffects(shutter=shutter or None, readout=readout or None)
    cameras = [Camera(torch.tensor(viewmats[i]).float(), Ks[i], WIDTH, HEIGHT) for i in range(count)]
    views = [(speeds.at(i), cameras[i]) for i in range(count)]
    with torch.no_grad():
        return truth, [(view, truth.draw([(scene, None)], *view, [Layer()])[0].image) for view in views], scene


@pytest.mark.parametrize(("name", "strength"), [("readout", 0.7), ("readout", -0.5), ("shutter", 0.8)])
def test_the_times_of_a_shutter_are_learned(name, strength, held):
    _, pictures, scene = moving_wall(**({"readout": 0.0, "shutter": 0.0} | {name: strength}))
    effects = FrameEffects(**{name: 0.0 if name == "readout" else 0.5})
    adam = torch.optim.Adam(effects.parameters(), lr=0.05)
    for step in range(60):
        view, image = pictures[step % len(pictures)]
        adam.zero_grad()
        (effects.draw([(scene, None)], *view, [Layer()])[0].image - image).abs().mean().backward()
        adam.step()
    held(abs(effects.known()[name] - strength), 0.1)


def test_a_correction_of_zero_changes_nothing_and_moves_centres_in_the_world(held):
    views = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    views[1, :3, :3] = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    views[1, :3, 3] = torch.tensor([0.5, 2.0, 3.0])
    zeros = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    there = correct_cameras(views, zeros, zeros)
    held((there - views).abs().max().item(), 1e-12)
    there.square().sum().backward()
    assert zeros.grad.isfinite().all()
    shift, turn = torch.tensor([0.1, -0.2, 0.3]).double(), torch.tensor([0.0, 0.0, 0.2]).double()
    moved = correct_cameras(views, turn.expand(2, 3), shift.expand(2, 3))
    centres = [-(v[:, :3, :3].mT @ v[:, :3, 3:])[..., 0] for v in (views, moved)]
    held((centres[1] - centres[0] - shift).abs().max(), 1e-12)
    held((moved[:, :3, :3] @ torch.linalg.matrix_exp(torch.tensor([[0, -0.2, 0], [0.2, 0, 0], [0, 0, 0]]).double())
          - views[:, :3, :3]).abs().max().item(), 1e-12)  # fmt: skip


def test_all_cameras_together_turn_and_move_nothing():
    frames, trained = FrameCorrections(4), torch.tensor([True, True, False, True])
    frames.turn.weight.data[:], frames.shift.weight.data[:] = 0.03, -0.2
    view = torch.eye(4)
    torch.testing.assert_close(frames.camera(1, view, trained), view)
    torch.testing.assert_close(frames.cameras(view.expand(4, 4, 4), trained, None), view.expand(4, 4, 4))


def test_cameras_not_trained_on_follow_errors_that_drift_and_not_those_of_each_frame():
    g, steps = torch.Generator().manual_seed(0), torch.arange(80.0)
    drifting = torch.stack([(steps / 12).sin(), (steps / 9).cos(), (steps / 15).sin()], 1)
    assert agreement(drifting) > 0.9 and agreement(torch.randn(80, 3, generator=g)) < 0.15
    assert agreement(torch.zeros(80, 3)) == 0 and agreement(torch.zeros(1, 3)) == 0


@pytest.mark.slow
def test_wrong_cameras_are_corrected(clip):
    views, person = clip
    wrong = views.viewmats.clone()
    wrong[:, 0, 3] += torch.tensor([0.06, -0.06, 0, 0.06, -0.06, 0.0])  # frame 2 is held out
    off = views._replace(viewmats=wrong)

    def error(cameras: torch.Tensor) -> float:
        away = (cameras - views.viewmats)[[0, 1, 3, 4, 5], 0, 3]
        return float((away - away.mean()).abs().mean())

    fit = fit_with((off, person), FrameEffects(), steps=130, refine_camera=True)
    run(fit, 130)
    assert error(fit.cameras()) < 0.6 * error(wrong)


def test_a_person_who_performs_takes_the_shadow_along(held):
    avatar, wall, to = tiny.make_avatar(read_body_model()), tiny.make_scene(), np.array([0.5, 0, 0])
    light = torch.nn.functional.normalize(torch.tensor([-1.0, 0.0, -1.5]), dim=0)
    plain, lit = (load_learned(avatar, wall, Effects()) for _ in range(2))
    rest = lit.avatar.resting
    parts = casters(rest.means, rest.weights)
    lit = replace(lit, avatar=lit.avatar._replace(casters=parts), effects=FrameEffects(Shadow(light, darkness=0.8)))
    poses, views = tiny.make_poses(), tiny.make_viewmats()
    over, size = np.tile([np.pi, 0, 0], (2, 1)), (tiny.WIDTH, tiny.HEIGHT)
    moves = (over, poses.body_pose[:2], poses.transl[3] + np.stack([0 * to, to]))
    camera = Camera.of(views[3], pinhole(tiny.FOCAL, *size), *size)
    casts = [Cast([PosedAvatar.of(one.avatar, *moves)], one.scene, one.effects) for one in (plain, lit)]
    lost = [255 * np.subtract(*(cast.at(i).picture(camera)[0] for cast in casts)) for i in range(2)]
    middles = []
    for i, dark in enumerate(lost):
        covered = draw(plain.person(tuple(part[i] for part in moves)), None, camera)[1]
        assert dark.min() >= -1 and dark.max() > 20 and dark[covered > 0.99].max() <= 1
        middles.append((dark.sum((0, 2)) * np.arange(tiny.WIDTH)).sum() / dark.sum())
    assert 5 < middles[1] - middles[0] < 17  # of 100 px * 0.5 m / 4.5 m = 11


def test_a_shadow_needs_a_person_and_a_scene():
    scene = moving_wall(0.0, 0.5, 1)[2]
    shadow = Cast((), scene, FrameEffects(Shadow(UP)))
    assert shadow.at(0).scene is scene and shadow._replace(scene=None).at(0).sets == []

"""The flag that Gaussians carry from training to every picture of them, and what it does there."""

import numpy as np
import pytest
import torch

from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera, Gaussians, rasterize
from stages.avatar.splats.gaussians import Splats
from stages.formats.splats import read_avatar, read_scene, write_splats
from stages.records import Avatar, Effects, Scene
from tests.made.learned import compose, load_learned

SIDE = 32
CAMERA = Camera(torch.eye(4), torch.tensor([[30.0, 0, SIDE / 2], [0, 30, SIDE / 2], [0, 0, 1]]), SIDE, SIDE)


def dots(seed: int, antialias: bool) -> Splats:
    """Gaussians much smaller than a pixel."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(40, 3, generator=generator) * torch.tensor([3.0, 3, 1]) + torch.tensor([-1.5, -1.5, 3])
    axes = 0.01 * torch.eye(3).repeat(40, 1, 1)
    return Splats(means, axes, torch.full((40,), 0.9), torch.rand(40, 1, 3, generator=generator), antialias=antialias)


def drawn(*sets: Splats | None) -> torch.Tensor:
    return compose(*sets, CAMERA)[0].image


def test_gaussians_are_drawn_as_they_were_learned():
    for antialias in (False, True):
        splats = dots(0, antialias)
        (direct,) = rasterize(Gaussians(*splats[:3], splats.colors(torch.zeros(3)), antialias), CAMERA)
        assert torch.equal(drawn(None, splats), direct.image) and torch.equal(drawn(splats, None), direct.image)
    plain, fine = drawn(None, dots(0, False)), drawn(None, dots(0, True))
    assert plain.sum() > 2 * fine.sum() > 0, "a dot of a tenth of a pixel is no dot of a pixel"


def test_sets_that_are_drawn_together_are_drawn_as_the_scene_was_learned():
    ours, theirs = (dots(0, True), dots(0, False)), (dots(1, True), dots(1, False))
    for scene in theirs:
        assert torch.equal(drawn(ours[0], scene), drawn(ours[1], scene))
    assert not torch.equal(drawn(ours[0], theirs[0]), drawn(ours[0], theirs[1]))


def test_the_sum_of_a_dot_is_what_it_covers_however_far_away():
    """Hard case A15: alpha summed over the picture is opacity x 2 pi x the dot's own area in pixels.

    That is so on average over places: with a blur as narrow as a pixel a lone dot is more where a pixel's middle is.
    """
    for size, swing in ((0.02, 0.4), (0.1, 0.05), (0.5, 0.05)):
        covered = []
        dot = Splats(torch.zeros(1, 3), size * torch.eye(3)[None], torch.tensor([0.5]), torch.ones(1, 1, 3))
        for x in torch.arange(0, 0.1, 0.02):  # a pixel is 0.1 m there
            for y in torch.arange(0, 0.1, 0.02):
                moved = dot._replace(means=torch.tensor([[x, y, 3.0]]), antialias=True)
                covered.append(compose(None, moved, CAMERA)[0].alpha.sum().item())
        area = 0.5 * 2 * np.pi * (30 * size / 3) ** 2
        assert np.mean(covered) == pytest.approx(area, rel=0.05), "the rest is under 1/255"
        assert np.abs(np.array(covered) / area - 1).max() < swing


def scene_arrays(antialias: bool) -> Scene:
    rng = np.random.default_rng(0)
    quats = np.tile([1.0, 0, 0, 0], (9, 1))
    place = rng.uniform(-1, 1, (9, 3)) + [0, 0, 4]
    sizes, opacities = np.full((9, 3), 0.01), np.full(9, 0.9)
    return Scene(place, quats, sizes, opacities, rng.random((9, 3)), np.zeros((9, 0, 3)), antialias=antialias)


def test_files_remember_it_and_say_nothing_of_it_where_it_is_off(tmp_path):
    more = {
        "lbs_weights": np.full((9, 24), 1 / 24),
        "joints": np.zeros((24, 3)),
        "parents": np.arange(24) - 1,
        "betas": np.zeros(10),
        "canonical_pose": np.zeros(69),
    }
    for antialias in (False, True):
        plain = scene_arrays(antialias)
        avatar = Avatar(**{f: getattr(plain, f) for f in plain.__dataclass_fields__}, **more)
        write_splats(tmp_path / "scene.npz", plain)
        write_splats(tmp_path / "avatar.npz", avatar)
        for name in ("scene.npz", "avatar.npz"):
            with np.load(tmp_path / name) as arrays:
                assert ("antialias" in arrays) is antialias and not [k for k in arrays if k.startswith("clothes")]
        read = read_avatar(tmp_path / "avatar.npz"), read_scene(tmp_path / "scene.npz")
        learned = load_learned(*read, Effects())
        posed = learned.person((np.zeros(3), np.zeros(69), np.zeros(3)))
        assert learned.scene.antialias is posed.antialias is antialias


def test_training_gradients_are_finite_where_a_dot_has_no_size():
    scene = SceneModel(torch.tensor([[0.0, 0, 3], [0.1, 0, 3]]), torch.rand(2, 3), 0, 1.0, antialias=True)
    with torch.no_grad():
        scene.log_scales[0] = -30.0  # 1e-13 m
    image = compose(None, scene.splats(), CAMERA)[0].image
    assert scene.splats().antialias and scene.splats().detach().antialias
    image.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in scene.parameters())
    assert scene.log_scales.grad[1].abs().sum() > 0

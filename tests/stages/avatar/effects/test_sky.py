"""The sky shell: where the sky is, what it looks like, and that training leaves it far away."""

import numpy as np
import torch

from stages.avatar.effects.sky import CELLS, RADIUS, open_sky, shell
from stages.avatar.model.scene import SceneModel, fill_points
from stages.training.step.densify import Growth, Rules, grow_scene
from stages.training.step.optimizers import optimizers
from stages.training.step.refine import FrameCorrections

WIDTH, HEIGHT = 60, 48
K = np.array([[50.0, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]])
VIEW = np.eye(4)
NOBODY = np.zeros((HEIGHT, WIDTH), np.uint8)


def points_at(pixels, depth: float = 3.0) -> np.ndarray:
    at = (np.asarray(pixels) - [WIDTH / 2, HEIGHT / 2]) / 50
    return np.concatenate([at, np.ones((len(at), 1))], 1) * depth


GROUND = points_at([(x, y) for x in range(WIDTH) for y in range(24, HEIGHT)])


def test_the_sky_reaches_from_the_top_to_the_first_points():
    sky = open_sky(GROUND, NOBODY, VIEW, K)
    cell = round(max(WIDTH, HEIGHT) / CELLS)
    assert sky[: 24 - cell].all() and not sky[24:].any()
    tower = np.concatenate([GROUND, points_at([(30, y) for y in range(HEIGHT)])])
    assert not open_sky(tower, NOBODY, VIEW, K)[:, 30].any(), "what has points is no sky"
    window = GROUND[~((abs(GROUND[:, 0]) < 0.5) & (abs(GROUND[:, 1] - 0.7) < 0.3))]
    assert not open_sky(window, NOBODY, VIEW, K)[24:].any(), "a hole that is not joined to the top is no sky"


def test_a_person_before_the_sky_is_not_sky_and_pictures_without_points_are_all_sky():
    person = NOBODY.copy()
    person[5:40, 20:30] = 255
    sky = open_sky(GROUND, person, VIEW, K)
    assert not sky[person > 0].any() and sky[2, 25]
    assert open_sky(np.zeros((0, 3)), NOBODY, VIEW, K).all()
    assert open_sky(-GROUND, NOBODY, VIEW, K).all(), "points behind the camera"
    everywhere = points_at([(x, y) for x in range(WIDTH) for y in range(HEIGHT)])
    assert not open_sky(everywhere, NOBODY, VIEW, K).any()


def test_the_shell_is_far_in_all_directions_of_the_sky_and_has_its_colours():
    sky = open_sky(GROUND, NOBODY, VIEW, K)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, :30], image[:, 30:] = [200, 0, 0], [0, 0, 100]
    moved = VIEW.copy()
    moved[:3, 3] = [0.5, 0, 0]
    views, Ks = np.stack([VIEW, moved]), np.stack([K, K])
    points, colours, middle = shell([sky, sky], [image, image], views, Ks, 2.0)
    np.testing.assert_allclose(middle, [-0.25, 0, 0])
    np.testing.assert_allclose(np.linalg.norm(points - middle, axis=1), RADIUS * 2, rtol=1e-6)
    seen = points / points[:, 2:] @ K.T
    assert (points[:, 2] > 0).all() and seen[:, 1].max() < 25 and len(points) > 500
    left = seen[:, 0] < 29
    np.testing.assert_allclose(colours[left], np.tile([200 / 255, 0, 0], (left.sum(), 1)))
    found = np.unique(seen[:, :2].astype(int) // 4, axis=0)
    assert len(found) == len(np.unique(np.argwhere(sky)[:, ::-1] // 4, axis=0)), "no hole"
    points, colours, _ = shell([np.zeros_like(sky)], [image], VIEW[None], K[None], 2.0)
    assert points.shape == colours.shape == (0, 3)


def test_nothing_is_filled_in_before_the_sky():
    sky = open_sky(GROUND, NOBODY, VIEW, K)
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    args = GROUND, [image], [NOBODY], VIEW[None], K[None], 400
    plain, _ = fill_points(*args, np.random.default_rng(0))
    without, _ = fill_points(*args, np.random.default_rng(0), [sky])
    rows = (plain / plain[:, 2:] @ K.T)[:, :2].astype(int)
    kept = plain[~sky[rows[:, 1], rows[:, 0]]]
    np.testing.assert_allclose(without, kept)
    assert 100 < len(without) < 300
    nothing, _ = fill_points(*args, np.random.default_rng(0), [np.zeros_like(sky)])
    assert np.array_equal(nothing, plain)


def surrounded(count: int = 40) -> SceneModel:
    middle = torch.tensor([500.0, 0, 0])  # farther from the origin than the shell from it
    scene = SceneModel(middle + torch.rand(30, 3), torch.rand(30, 3), 1, 1.0)
    far = torch.nn.functional.normalize(torch.randn(count, 3), dim=1) * RADIUS
    scene.add_sky(middle + far, torch.rand(count, 3), middle, RADIUS)
    return scene


def test_growth_sees_the_shell_as_angles_and_leaves_it_there():
    torch.manual_seed(0)
    scene = surrounded()
    assert len(scene) == 70 and scene.shN.shape == (70, 3, 3)
    largest = scene.log_scales.detach().exp().amax(1)
    assert (largest[30:] > 5).all(), "hundreds of metres away they are metres large"
    sizes = scene.sizes().amax(1)
    torch.testing.assert_close(sizes[:30], largest[:30], rtol=0, atol=0)
    torch.testing.assert_close(sizes[30:], largest[30:] / RADIUS)
    adam = optimizers(FrameCorrections(2), {}, scene, 1.0)["scene"]
    rules = Rules(2e-4, 0.01, 0.5, 0.3, 0.005, 70)
    rows = grow_scene(scene, adam, Growth(70), rules, 1, torch.Generator())
    assert rows.pruned == 0 and len(scene) == 70


def test_without_a_shell_sizes_are_what_they_were():
    scene = SceneModel(1e4 * torch.rand(30, 3), torch.rand(30, 3), 0, 1.0)
    assert torch.equal(scene.sizes(), scene.log_scales.detach().exp())

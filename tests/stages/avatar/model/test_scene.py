"""The scene's Gaussians: lengths, the start from points, and points that fill what SfM left empty."""

import numpy as np
import pytest
import torch

from stages.avatar.model.scene import SceneModel, clear_of_cameras, fill_points, scene_extent
from stages.avatar.splats.gaussians import Splats, spacing


def ring(n: int = 5, radius: float = 2.0) -> torch.Tensor:
    viewmats = torch.eye(4).repeat(n, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(-radius, radius, n)
    viewmats[:, 2, 3] = 4
    return viewmats


def test_h05_extent_follows_the_cameras_and_survives_a_tripod():
    points = torch.rand(50, 3) - 0.5
    assert scene_extent(ring(), points) == pytest.approx(2.2, rel=0.1)
    still = scene_extent(ring(radius=0.0), points)
    assert still == pytest.approx(2.0, rel=0.1)
    assert scene_extent(ring(radius=0.0), torch.zeros(0, 3)) == 1.0
    assert scene_extent(ring(radius=0.0), points - torch.tensor([0, 0, 50.0])) == 1.0


def test_i18_a_few_points_at_the_end_of_the_world_change_no_length(held):
    points, viewmats = torch.rand(500, 3) - 0.5, ring(radius=0.0)
    far = torch.cat([points, torch.full((5, 3), 1e6)])
    held(abs(scene_extent(viewmats, far) / scene_extent(viewmats, points) - 1), 0.02)
    near, alike = spacing(points, 2.0), spacing(far, 2.0)
    assert torch.equal(near, alike[:500]) and alike[500:].max() <= 0.2


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_i05_extent_scales_with_the_world(scale):
    points, viewmats = torch.rand(50, 3) - 0.5, ring()
    scaled = viewmats.clone()
    scaled[:, :3, 3] *= scale
    assert scene_extent(scaled, points * scale) == pytest.approx(scale * scene_extent(viewmats, points), rel=1e-5)


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_h18_spacing_of_few_points_has_limits(n):
    distance = spacing(torch.rand(n, 3), 2.0)
    assert distance.shape == (n,) and ((distance >= 2e-7) & (distance <= 0.2)).all()


def test_h18_spacing_of_duplicates_and_of_a_grid():
    assert torch.equal(spacing(torch.ones(100, 3), 1.0), torch.full((100,), 1e-7))
    grid = torch.stack(torch.meshgrid(*[torch.arange(4.0) * 0.01] * 3, indexing="ij"), -1).reshape(-1, 3)
    assert torch.allclose(spacing(grid, 1.0), torch.full((64,), 0.01), rtol=1e-4)


def test_h18_a_scene_starts_as_its_points_and_needs_one():
    points, rgb = torch.rand(20, 3), torch.rand(20, 3)
    splats = SceneModel(points, rgb, 2, 1.0).splats()
    assert torch.equal(splats.means, points)
    assert torch.allclose(splats.colors(torch.tensor([0.0, 0, -3])), rgb, atol=1e-6)
    with pytest.raises(ValueError, match="at least one point"):
        SceneModel(torch.zeros(0, 3), torch.zeros(0, 3), 0, 1.0)


def test_h17_a_gaussian_on_the_camera_has_a_colour_and_a_gradient():
    means = torch.zeros(1, 3, requires_grad=True)
    splats = Splats(means, torch.eye(3)[None], torch.ones(1), torch.ones(1, 4, 3))
    color = splats.colors(torch.zeros(3))
    color.sum().backward()
    assert color.isfinite().all() and means.grad.isfinite().all()


def test_h17_points_on_a_camera_are_told_from_those_before_it():
    points = torch.tensor([[0.0, 0, -4], [0.03, 0, -4], [0.05, 0, -4], [0, 0, 0]])
    assert clear_of_cameras(points, ring(radius=0.0), 2.0).tolist() == [False, False, True, True]
    assert clear_of_cameras(points * 1e3, _wider(ring(radius=0.0), 1e3), 2e3).tolist() == [False, False, True, True]
    assert len(clear_of_cameras(torch.zeros(0, 3), ring(), 1.0)) == 0


def _wider(viewmats: torch.Tensor, scale: float) -> torch.Tensor:
    wider = viewmats.clone()
    wider[:, :3, 3] *= scale
    return wider


def test_filled_points_lie_on_the_wall_and_never_where_the_person_is():
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform(-3, 3, (300, 2)), np.full((300, 1), 5.0)], 1)
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, 3] = [0.3, -0.2, 0.5]
    image = rng.integers(0, 250, (48, 64, 3), dtype=np.uint8)
    mask = np.zeros((48, 64), np.uint8)
    mask[10:30, 20:40] = 255
    image[mask > 0] = 255
    xyz, rgb = fill_points(wall, [image], [mask], viewmat[None], K[None], 400, rng)
    assert 300 < len(xyz) < 400 and np.allclose(xyz[:, 2], 5, atol=1e-6)
    local = xyz + viewmat[:3, 3]
    column, row = ((local[:, :2] / local[:, 2:]) * 50 + [32, 24]).T.astype(int)
    assert (image[row, column] == rgb).mean() > 0.95 and (rgb < 255).all()
    for points, shown in ((wall[:5], mask), (wall, np.full_like(mask, 255))):
        none, _ = fill_points(points, [image], [shown], viewmat[None], K[None], 400, rng)
        assert len(none) == 0


def test_what_a_picture_teaches_is_pulled_to_be_faint_and_small_and_nothing_else_is():
    scene = SceneModel(torch.rand(20, 3), torch.rand(20, 3), 0, 2.0).double()
    with torch.no_grad():
        scene.logit_opacities.copy_(torch.linspace(-6, 15, 20))
    pulled = 0.5 * (scene.logit_opacities.sigmoid().mean() + scene.log_scales.exp().mean() / 2.0)
    slopes = torch.autograd.grad(pulled, (scene.logit_opacities, scene.log_scales))
    taught = torch.arange(20) % 2
    scene.logit_opacities.grad, scene.log_scales.grad = (
        taught * 1e-3 * torch.ones(20).double(),
        torch.zeros(20, 3).double(),
    )
    scene.add_sparsity_gradient(0.5)
    assert torch.allclose(scene.logit_opacities.grad, taught * (1e-3 + slopes[0]), rtol=1e-12)
    assert torch.allclose(scene.log_scales.grad, taught[:, None] * slopes[1], rtol=1e-12)

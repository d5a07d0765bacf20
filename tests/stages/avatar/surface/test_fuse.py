"""Gaussians on a sphere become a closed sphere of its size; two balls stay two."""

import numpy as np
import pytest
import torch

from stages.avatar.splats.gaussians import Splats
from stages.avatar.surface import fuse
from stages.avatar.surface.fuse import fused
from stages.avatar.surface.looks import all_around
from tests.made.meshes import FEW, balls, edges


def test_a_sphere_of_gaussians_becomes_a_closed_sphere():
    splats = balls([0.1, 0.2, -0.1])
    vertices, faces = fused(splats, all_around(splats.means.numpy(), 200, FEW), 0.01)
    radii = np.linalg.norm(vertices - [0.1, 0.2, -0.1], axis=1)
    assert 0 < radii.mean() - 0.15 < 0.012 and radii.std() < 0.003, "as far as Gaussians show"
    assert (edges(faces) == 2).all()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * radii.mean() ** 3, rel=0.03), (
        "from outside counter-clockwise, and hollow nowhere"
    )


def test_two_balls_that_nearly_touch_stay_two():
    splats = balls([-0.17, 0, 0], [0.17, 0, 0])
    vertices, _ = fused(splats, all_around(splats.means.numpy(), 200, FEW), 0.01)
    assert (np.abs(vertices[:, 0]) > 0.01).all()


@pytest.mark.parametrize("opacity", [0.05, 0.3])
def test_a_haze_has_no_surface(opacity):
    splats = balls([0, 0, 0], count=60)
    splats = splats._replace(opacities=torch.full_like(splats.opacities, opacity))
    vertices, faces = fused(splats, all_around(splats.means.numpy(), 100, FEW), 0.02)
    assert vertices.shape == faces.shape == (0, 3)


@pytest.mark.parametrize(("opacity", "sign"), [(0.95, 1), (0.11, -1)])
def test_pixels_that_show_two_surfaces_say_nothing_of_either(opacity, sign):
    """A wall 6 cm ahead of another; half seen through, the mean depth of both lies 3 cm from each."""
    across = np.stack(np.meshgrid(*[np.arange(-10, 11) * 0.01] * 2), -1).reshape(-1, 2)
    means = np.concatenate([np.insert(across, 2, z, 1) for z in (0.0, -0.06)])
    opacities = np.repeat([opacity, 0.95], len(across))
    axes = np.tile(np.diag([0.01, 0.01, 0.001]), (len(means), 1, 1))
    parts = (means, axes, opacities, np.zeros((len(means), 1, 3)))
    walls = Splats(*(torch.as_tensor(part).float() for part in parts))
    ahead = all_around(means, 100, [(0, 1, 0)])
    assert np.sign(fuse._distances(torch.tensor([[0.0, 0.0, 0.01]]), walls, ahead).item()) == sign

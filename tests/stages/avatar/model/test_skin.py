"""Where a person's Gaussians begin: as far apart on fine triangles as on coarse ones."""

import math

import numpy as np
import pytest
import torch
import trimesh

from stages.avatar.model.skin import APART, HALF, even_skin
from stages.avatar.splats.neighbours import nearest

COUNT = 2000


def ball(fine_above: float = 2.0) -> tuple[torch.Tensor, torch.Tensor]:
    """A sphere of radius 0.5 m, whose triangles are a sixteenth as large above a height."""
    mesh = trimesh.creation.icosphere(3, 0.5)
    high = mesh.triangles_center[:, 1] > fine_above
    finer = mesh.submesh([np.flatnonzero(high)], append=True).subdivide().subdivide() if high.any() else None
    parts = [mesh.submesh([np.flatnonzero(~high)], append=True), *([finer] if finer else [])]
    whole = trimesh.util.concatenate(parts)
    return torch.tensor(np.array(whole.vertices)).float(), torch.tensor(np.array(whole.faces)).long()


def spread(vertices: torch.Tensor, faces: torch.Tensor, count: int = COUNT):
    weights = torch.stack([vertices[:, 1] + 0.5, 0.5 - vertices[:, 1]], 1)
    return even_skin(vertices, faces, weights, count)


def test_as_many_as_asked_for_and_none_near_another():
    skin = spread(*ball())
    apart = APART * math.sqrt(4 * math.pi * 0.25 / COUNT)
    away = nearest(skin.means, skin.means, 2)[0][:, 1]
    assert abs(len(skin.means) - COUNT) < 0.05 * COUNT
    assert away.min() > 0.99 * apart and away.max() < 2 * apart, "and no hole that another would fit in"
    torch.testing.assert_close(skin.scales[:, 0], torch.full_like(skin.scales[:, 0], HALF * apart), rtol=0.01, atol=0)


def test_fine_triangles_have_no_more_than_coarse_ones():
    vertices, faces = ball(fine_above=0.0)
    centres = vertices[faces].mean(1)
    assert (centres[:, 1] > 0).sum() > 10 * (centres[:, 1] < 0).sum()
    upper = (spread(vertices, faces).means[:, 1] > 0).float().mean()
    assert abs(upper - 0.5) < 0.03


def test_they_lie_on_the_skin_face_outwards_and_have_its_weights():
    skin = spread(*ball())
    radius = skin.means.norm(dim=1)
    assert radius.max() <= 0.5 + 1e-6 and radius.min() > 0.49
    assert (skin.rotations[:, :, 2] * skin.means / radius[:, None]).sum(1).min() > 0.98
    torch.testing.assert_close(skin.weights[:, 0], skin.means[:, 1] + 0.5, atol=1e-5, rtol=0)
    torch.testing.assert_close(skin.weights.sum(1), torch.ones(len(skin.means)))


def test_the_same_mesh_gives_the_same_points():
    torch.manual_seed(1)
    first = spread(*ball())
    torch.manual_seed(2)
    assert all(torch.equal(a, b) for a, b in zip(first, spread(*ball()), strict=True))


@pytest.mark.parametrize("count", [1, 5, 60])
def test_triangles_without_area_get_none_and_few_points_are_points(count):
    vertices, faces = ball()
    flat = torch.tensor([[0, 0, 1], [2, 2, 2]])
    lonely = torch.cat([vertices, torch.full((1, 3), 9.0)])
    skin = spread(lonely, torch.cat([flat, faces, flat]), count)
    assert 0 < len(skin.means) <= 2 * count and all(part.isfinite().all() for part in skin)
    assert skin.means.norm(dim=1).max() < 0.51

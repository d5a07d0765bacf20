"""A texture shows on each side what the Gaussians show there."""

import numpy as np
import torch
import trimesh

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.surface import texture
from stages.avatar.surface.fuse import fused
from stages.avatar.surface.looks import all_around
from stages.avatar.surface.texture import baked, unwrapped
from stages.records import SH_C0
from tests.made.meshes import FEW, balls


def colours_at(uvs, picture):
    at = np.clip((uvs * len(picture)).astype(int), 0, len(picture) - 1)
    return picture[at[:, 1], at[:, 0]] / 255


def _large(charts):
    """Faces of more than 4 texels."""
    a, b, c = (charts.uvs[charts.faces[:, k]] * 512 for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return np.abs(ux * vy - uy * vx) > 8


def test_a_ball_red_ahead_and_blue_behind_is_textured_so():
    splats = balls([0, 0, 0])
    ahead = splats.means[:, 2:] > 0
    rgb = torch.where(ahead, torch.tensor([[0.8, 0.2, 0.1]]), torch.tensor([[0.1, 0.2, 0.8]]))
    splats = splats._replace(sh=((rgb - 0.5) / SH_C0)[:, None])
    vertices, faces = fused(splats, all_around(splats.means.numpy(), 200, FEW), 0.02)
    charts = unwrapped(vertices, faces, 512)
    assert charts.uvs.min() >= 0 and charts.uvs.max() <= 1
    np.testing.assert_array_equal(charts.rows[charts.faces], faces)
    normals = vertex_normals(torch.as_tensor(vertices), torch.as_tensor(faces)).numpy()
    cut = charts.rows
    picture = baked(charts, vertices[cut], normals[cut], splats, all_around(splats.means.numpy(), 256, FEW), 512)
    assert picture.shape == (512, 512, 3) and picture.dtype == np.uint8
    whole = np.isin(np.arange(len(cut)), charts.faces[_large(charts)])  # others may lie between texels
    found, z = colours_at(charts.uvs, picture)[whole], vertices[cut][whole, 2]
    np.testing.assert_allclose(found[z > 0.04], np.tile([0.8, 0.2, 0.1], ((z > 0.04).sum(), 1)), atol=0.06)
    np.testing.assert_allclose(found[z < -0.04], np.tile([0.1, 0.2, 0.8], ((z < -0.04).sum(), 1)), atol=0.06)


def test_a_camera_sees_what_nothing_hides_and_counts_what_it_looks_at_squarely():
    """Two balls, one behind the other: of the one behind a rim at most is seen, and of the one ahead its front."""
    splats = balls([0, 0, 0], [0, 0, -0.5])
    ball = trimesh.creation.icosphere(3, 0.15)
    vertices = np.concatenate([ball.vertices, ball.vertices + [0, 0, -0.5]])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    places = torch.as_tensor(vertices).float()
    facing = torch.as_tensor(np.tile(ball.vertex_normals, (2, 1))).float()
    ahead = all_around(splats.means.numpy(), 256, [(0, 1, 0)])[0].to(places)
    rows, _, counts = texture._seen(places, facing, faces, vertices, splats, ahead)
    eye = torch.as_tensor(-ahead.viewmat[:3, :3].T @ ahead.viewmat[:3, 3])
    cosine = ((eye - places) * facing).sum(1) / (eye - places).norm(dim=1)
    front = torch.arange(len(places)) < len(ball.vertices)
    seen = torch.zeros(len(places), dtype=torch.bool).index_fill(0, rows, True)
    assert seen[front & (cosine > 0.25)].all() and not seen[cosine < 0.2].any() and not seen[~front].any()
    whole = cosine[rows] > 0.6  # nearer to the rim the ball covers pixels in part
    np.testing.assert_allclose(counts[whole], cosine[rows][whole] ** 12, atol=0.03)


def test_what_no_camera_sees_has_the_colours_of_the_gaussians_around():
    splats = balls([0, 0, 0])
    green = splats._replace(sh=torch.zeros_like(splats.sh) + torch.tensor([-1.0, 1.0, -1.0]))
    vertices, faces = fused(splats, all_around(splats.means.numpy(), 200, FEW), 0.02)
    charts = unwrapped(vertices, faces, 64)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    cut = charts.rows
    picture = baked(charts, vertices[cut], normals[cut], green, [], 64)
    shown = np.round(255 * np.clip([0.5 - SH_C0, 0.5 + SH_C0, 0.5 - SH_C0], 0, 1))
    np.testing.assert_allclose(colours_at(charts.uvs, picture) * 255, np.tile(shown, (len(cut), 1)), atol=1)

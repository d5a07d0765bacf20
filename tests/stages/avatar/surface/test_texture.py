"""A texture shows on each side what the Gaussians show there."""

import numpy as np
import torch

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.surface.fuse import fused
from stages.avatar.surface.looks import all_around
from stages.avatar.surface.texture import baked, unwrapped
from stages.records import SH_C0
from tests.made.meshes import FEW, balls


def colours_at(uvs, texture):
    at = np.clip((uvs * len(texture)).astype(int), 0, len(texture) - 1)
    return texture[at[:, 1], at[:, 0]] / 255


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
    texture = baked(charts, vertices[cut], normals[cut], splats, all_around(splats.means.numpy(), 256, FEW), 512)
    assert texture.shape == (512, 512, 3) and texture.dtype == np.uint8
    whole = np.isin(np.arange(len(cut)), charts.faces[_large(charts)])  # others may lie between texels
    found, z = colours_at(charts.uvs, texture)[whole], vertices[cut][whole, 2]
    np.testing.assert_allclose(found[z > 0.04], np.tile([0.8, 0.2, 0.1], ((z > 0.04).sum(), 1)), atol=0.06)
    np.testing.assert_allclose(found[z < -0.04], np.tile([0.1, 0.2, 0.8], ((z < -0.04).sum(), 1)), atol=0.06)


def test_what_no_camera_sees_has_the_colours_of_the_gaussians_around():
    splats = balls([0, 0, 0])
    green = splats._replace(sh=torch.zeros_like(splats.sh) + torch.tensor([-1.0, 1.0, -1.0]))
    vertices, faces = fused(splats, all_around(splats.means.numpy(), 200, FEW), 0.02)
    charts = unwrapped(vertices, faces, 64)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    cut = charts.rows
    texture = baked(charts, vertices[cut], normals[cut], green, [], 64)
    shown = np.round(255 * np.clip([0.5 - SH_C0, 0.5 + SH_C0, 0.5 - SH_C0], 0, 1))
    np.testing.assert_allclose(colours_at(charts.uvs, texture) * 255, np.tile(shown, (len(cut), 1)), atol=1)

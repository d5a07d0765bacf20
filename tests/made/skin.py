"""A person's first Gaussians where a test wants them: one on each vertex."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.body.smpl import vertex_normals
from stages.avatar.model.person import Surfels


def on_vertices(vertices: Tensor, faces: Tensor, weights: Tensor) -> Surfels:
    """A flat Gaussian on each of vertices[V,3] m, half as large as the edges there are long; faces[T,3], weights[V,J]."""
    half = (0.5 * edge_lengths(vertices, faces)).clamp_min(1e-4)
    sizes = torch.stack([half, half, 0.5 * half], 1)
    return Surfels(vertices, rotation_z_to(vertex_normals(vertices, faces)), sizes, weights)


def edge_lengths(vertices: Tensor, faces: Tensor) -> Tensor:
    """Mean length [V] in metres of the edges at each of vertices[V,3]; zero for a vertex in no face."""
    corners = vertices[faces]
    lengths = (corners - corners.roll(-1, 1)).norm(dim=2)
    around = lengths + lengths.roll(1, 1)
    total, count = (torch.zeros(len(vertices)).to(vertices) for _ in range(2))
    total.index_add_(0, faces.flatten(), around.flatten())
    count.index_add_(0, faces.flatten(), torch.full_like(around, 2).flatten())
    return total / count.clamp_min(1)

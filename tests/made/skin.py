"""A person's first Gaussians where a test wants them: one on each vertex."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.body.smpl import edge_lengths, vertex_normals
from stages.avatar.model.person import Surfels


def on_vertices(vertices: Tensor, faces: Tensor, weights: Tensor) -> Surfels:
    """A flat Gaussian on each of vertices[V,3] m, half as large as the edges there are long; faces[T,3], weights[V,J]."""
    half = (0.5 * edge_lengths(vertices, faces)).clamp_min(1e-4)
    sizes = torch.stack([half, half, 0.5 * half], 1)
    return Surfels(vertices, rotation_z_to(vertex_normals(vertices, faces)), sizes, weights)

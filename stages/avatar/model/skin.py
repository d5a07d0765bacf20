"""The skin as a person's Gaussians begin on it: the same distance apart everywhere, however fine the mesh is."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.body.smpl import vertex_normals
from stages.avatar.model.person import Surfels

CANDIDATES = 8  # points by chance on the skin, for each that is kept
APART = 0.73  # of the side of the square of skin that a point has for itself: so far no other is kept
HALF = 0.6  # of that distance: sigma along the skin, about half of the way to the points around


def even_skin(vertices: Tensor, faces: Tensor, weights: Tensor, count: int) -> Surfels:
    """About `count` flat Gaussians on the mesh vertices[V,3] m, faces[T,3], weights[V,J]; the same ones for the same mesh.

    A body model's mesh is fine where it bends: hands, feet and head are a fifth of the skin and have over half of its
    vertices. There Gaussians would be far smaller than a pixel, and too large on chest and back. Poisson-disk sampling: of
    points by chance, in an order by chance, each is kept that is not too near to one kept before (Cook 1986).
    """
    rng = np.random.default_rng(0)
    corners = vertices[faces].double().cpu().numpy()
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    tried = CANDIDATES * count
    at = areas.sum() * (np.arange(tried) + rng.random(tried)) / tried
    face = np.searchsorted(areas.cumsum(), at).clip(max=len(faces) - 1)
    root, along = np.sqrt(rng.random(tried)), rng.random(tried)
    share = np.stack([1 - root, root * (1 - along), root * along], 1)
    apart = APART * math.sqrt(areas.sum() / count)
    kept = _apart((share[..., None] * corners[face]).sum(1), apart, rng.permutation(tried))
    rows, part = faces[torch.as_tensor(face[kept]).to(faces.device)], torch.as_tensor(share[kept]).to(vertices)

    def there(values: Tensor) -> Tensor:
        return (part[..., None] * values[rows]).sum(1)

    normals = F.normalize(there(vertex_normals(vertices, faces)), dim=1)
    sizes = HALF * apart * torch.tensor([1, 1, 0.5]).to(vertices)
    return Surfels(there(vertices), rotation_z_to(normals), sizes.expand(len(rows), 3), there(weights))


def _apart(points: np.ndarray, apart: float, order: np.ndarray) -> np.ndarray:
    """Rows of points[N,3] of which no two are nearer than `apart`: one after the other by `order`[N], where there is room."""
    one, other = cKDTree(points).query_pairs(apart, output_type="ndarray").T
    free, kept = np.ones(len(points), bool), np.zeros(len(points), bool)
    while len(one):
        first = order.copy()
        np.minimum.at(first, one, order[other])
        np.minimum.at(first, other, order[one])
        chosen = free & (first == order)  # nobody near comes before
        kept |= chosen
        free &= ~chosen
        free[one[chosen[other]]] = free[other[chosen[one]]] = False
        left = free[one] & free[other]
        one, other = one[left], other[left]
    return np.flatnonzero(kept | free)

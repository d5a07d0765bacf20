"""An opaque lining under the person's surface, which shows in holes that new poses tear open."""

from __future__ import annotations

import math

import torch
import trimesh
from torch import Tensor

from stages.avatar.model.person import Canonical, Surfels
from stages.avatar.model.skin import even_skin
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import mean_near, median_near, nearest
from stages.avatar.surface.fuse import SEEN, Shell, fused
from stages.avatar.surface.looks import all_around
from stages.training.finishing.painted import count_pixels
from stages.training.views import FittedBody, Views

CELL, LOOK = 0.01, 256  # m, px: of the grid and of the pictures that the surface is made from
SIDE = 0.018  # m: of the square of surface that a lining Gaussian has for itself
UNDER = 0.028  # m under the surface, which lies 1 cm over the middles of Gaussians
THIN = 0.7  # of its depth: a point nearer than this to another side goes half as deep
WIDE, FLAT = 0.72, 0.2  # sigma along the surface, of SIDE; across it, of that
LEAK = 4e-7  # of the person's pixels: a lining Gaussian that paints more beside the person shows there
BEFORE = 0.15  # of what it would paint with nothing before it: one that paints more lies before the person
NEIGHBOURS = 8  # that give colour and skinning weights
OPAQUE = 0.5  # opacity from which they do


def add_lining(person: Canonical, body: FittedBody, views: Views, frames: list[int]) -> Canonical:
    """The person and, after its rows, opaque Gaussians evenly under its own surface, in the colours above.

    Those that would show in `frames` of `views` are left out: beside the person's masks, and before the person.
    """
    shell = _shell(person)
    if len(shell.faces) == 0:
        return person
    lined = _lined(person, _skin(person, shell))
    painted = count_pixels(lined, body, views, frames)
    kept = (painted.beside <= LEAK * painted.pixels) & (painted.clear <= BEFORE)
    kept[: len(person.means)] = True
    return Canonical(*(part[kept] for part in lined))


def _shell(person: Canonical) -> Shell:
    """The surface that the person's Gaussians form, an empty one where nothing is solid."""
    axes = (person.rotations * person.scales[:, None, :]).cpu()
    splats = Splats(person.means.cpu(), axes, person.opacities.cpu(), person.sh.cpu())
    seen = splats.means[splats.opacities > SEEN].numpy()
    return fused(splats, all_around(seen, LOOK) if len(seen) else [], CELL)


def _skin(person: Canonical, shell: Shell) -> Surfels:
    """Points evenly on the person's surface."""
    vertices, faces = torch.as_tensor(shell.vertices).to(person.means), torch.as_tensor(shell.faces)
    opaque, area = _opaque(person), trimesh.Trimesh(*shell, process=False).area
    weights = mean_near(person.weights[opaque], person.means[opaque], vertices, NEIGHBOURS)
    return even_skin(vertices, faces.to(vertices.device), weights, math.ceil(area / SIDE**2))


def _lined(person: Canonical, skin: Surfels) -> Canonical:
    """The person, and Gaussians UNDER all points of its surface, less deep and smaller where it is thin."""
    normals, opaque = skin.rotations[..., 2], _opaque(person)
    depth = torch.full_like(skin.means[:, :1], UNDER)
    for _ in range(6):
        distance, _ = nearest(skin.means, skin.means - depth * normals, 1)
        depth = torch.where(distance < THIN * depth, 0.5 * depth, depth)
    inner = Canonical(
        means=skin.means - depth * normals,
        rotations=skin.rotations,
        scales=WIDE * SIDE * depth / UNDER * torch.tensor([1, 1, FLAT]).to(depth),
        opacities=torch.full_like(depth[:, 0], 0.99),
        sh=median_near(person.sh[opaque], person.means[opaque], skin.means, NEIGHBOURS)[0],
        weights=skin.weights,
        normals=normals,
    )
    return Canonical(*(torch.cat(pair) for pair in zip(person, inner, strict=True)))


def _opaque(person: Canonical) -> Tensor:
    """Which Gaussians [N] have a colour and weights to give: the opaque ones, or the most opaque where none is."""
    return person.opacities >= person.opacities.max().clamp(max=OPAQUE)

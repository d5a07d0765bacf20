"""An opaque lining under skin and cloth, which shows in holes that new poses tear open."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.smpl import edge_lengths
from stages.avatar.model.person import Canonical
from stages.avatar.splats.neighbours import median_near, nearest
from stages.training.finishing.painted import count_pixels
from stages.training.views import FittedBody, Views

UNDER_SKIN = (0.02, 1.2), (0.034, 1.2), (0.058, 1.2), (0.058, 0.7)
"""m under the skin, and sigma in halves of a gap between vertices: a lining Gaussian that shows takes the next place."""
UNDER_CLOTH = (0.02, 1.4), (0.03, 1.4), (0.04, 1.2), (0.04, 0.8)
"""The same under cloth, by the distance between its points. It is wider: a kick makes a skirt twice as wide."""
OUT = len(UNDER_SKIN)
"""The place after the last: it is left out."""
THIN = 0.7  # of its depth: a point nearer than this to skin or cloth of another side goes half as deep
FLAT = 0.2  # of its lesser width: how thick a lining Gaussian is
NARROW = 0.25  # of the mean edge at a vertex: no lining is narrower, where the edges are all but in line
LEAK = 4e-7  # of the person's pixels: a lining Gaussian that paints more beside the person shows there
BEFORE = 0.15  # of what it would paint with nothing before it: one that paints more lies before the person
MUCH = 30.0  # times as much: at last those go that show so much, now that others are gone which hid them
NEIGHBOURS = 8  # that tell the colour above a lining Gaussian, and whether there is cloth
OPAQUE = 0.5  # opacity from which they do


def add_lining(person: Canonical, body: FittedBody, views: Views, frames: list[int]) -> Canonical:
    """The person and, after its rows, the points of the body's skin and cloth moved inwards and opaque, in the colours above.

    Where one would show in `frames` of `views`, it goes deeper, then becomes smaller, and is left out at last: beside the
    person's masks, where the person is thinner than the body or the body is beside it, and before the person, where its surface
    lies deeper than the lining, as faces often do. Cloth where the person did not become opaque, as the hull over the opening of
    a coat, has none.
    """
    place = OUT * _sheer(person, body).long()
    for leak, step in [*[(LEAK, 1)] * (OUT - 1), (LEAK, OUT), (MUCH * LEAK, OUT)]:
        inner, rows = _lining(person, body, place)
        both = Canonical(*(torch.cat(pair) for pair in zip(person, inner, strict=True)))
        painted = count_pixels(both, body, views, frames)
        shows = (painted.beside > leak * painted.pixels) | (painted.clear > BEFORE)
        place[rows[shows[len(person.means) :]]] += step
    inner, _ = _lining(person, body, place)
    return Canonical(*(torch.cat(pair) for pair in zip(person, inner, strict=True)))


def _sheer(person: Canonical, body: FittedBody) -> Tensor:
    """Which points of skin and cloth [S] are of cloth where the person did not become opaque."""
    sheer = torch.zeros(len(body.surface()[0]), dtype=torch.bool, device=person.means.device)
    if body.cloth is not None:
        around, _ = median_near(person.opacities[:, None], person.means, body.cloth.means, NEIGHBOURS)
        sheer[len(body.vertices) :] = around[:, 0] < OPAQUE
    return sheer


def _lining(person: Canonical, body: FittedBody, place: Tensor) -> tuple[Canonical, Tensor]:
    """Gaussians under those points of skin and cloth whose `place`[S] is not OUT, and their rows [M]."""
    surface, normals, weights = body.surface()
    turns, gaps = _gaps(body.vertices, body.faces, normals[: len(body.vertices)])
    if body.cloth is not None:
        turns = torch.cat([turns, body.cloth.rotations])
        gaps = torch.cat([gaps, 2 * body.cloth.scales[:, :2]])
    rows = (place < OUT).nonzero()[:, 0]
    cloth = (rows >= len(body.vertices)).long()
    depth, wide = torch.tensor([UNDER_SKIN, UNDER_CLOTH]).to(surface)[cloth, place[rows]].split(1, 1)
    for _ in range(6):
        distance, _ = nearest(surface, surface[rows] - depth * normals[rows], 1)
        depth = torch.where(distance < THIN * depth, 0.5 * depth, depth)
    means, sigmas = surface[rows] - depth * normals[rows], wide * 0.5 * gaps[rows]
    opaque = person.opacities >= person.opacities.max().clamp(max=OPAQUE)
    inner = Canonical(
        means=means,
        rotations=turns[rows],
        scales=torch.cat([sigmas, FLAT * sigmas[:, 1:]], 1),
        opacities=torch.full_like(means[:, 0], 0.99),
        sh=median_near(person.sh[opaque], person.means[opaque], means, NEIGHBOURS)[0],
        weights=weights[rows],
        normals=normals[rows],
    )
    return inner, rows


def _gaps(vertices: Tensor, faces: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """The way of the longest, the shortest gaps between vertices[V,3], as columns of rotations [V,3,3] whose third are their
    normals[V,3] or those reversed, and their lengths [V,2] in metres, the first no shorter.

    Around a calf vertices are 2 cm apart and along it 6: a lining as wide as it is long would be a haze beside it. Lengths are
    from NARROW to 1 of the mean of the edges there: longer ends of a lining would stick out.
    """
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = torch.cat([ends, ends.flip(1)])
    start, out = ends[:, 0], normals[ends[:, 0]]
    edges = vertices[ends[:, 1]] - vertices[start]
    edges = edges - (edges * out).sum(1, keepdim=True) * out
    spread = torch.zeros_like(vertices[:, :, None] * normals[:, None])
    spread.index_add_(0, start, edges[:, :, None] * edges[:, None])
    count = torch.zeros_like(vertices[:, 0]).index_add_(0, start, torch.ones_like(edges[:, 0])).clamp_min(1)
    mean = edge_lengths(vertices, faces)[:, None]
    ways = spread / (count[:, None] * mean.square()).clamp_min(1e-12)[..., None]  # an eyelid's edges are 1 mm long
    squared, axes = torch.linalg.eigh(ways - normals[:, :, None] * normals[:, None])
    squared, axes = squared.flip(1), axes.flip(2)
    lengths = mean * (2 * squared[:, :2].clamp_min(0)).sqrt().clamp(NARROW, 1)
    return axes * torch.linalg.det(axes)[:, None, None].sign(), lengths

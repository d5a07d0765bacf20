"""An opaque lining under the skin, which shows in holes that new poses tear open."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.body.smpl import edge_lengths, vertex_normals
from stages.avatar.model.person import Canonical
from stages.avatar.splats.neighbours import median_near, nearest
from stages.training.finishing.painted import count_pixels
from stages.training.views import Person, Views

PLACES = ((0.02, 1.2), (0.034, 1.2), (0.058, 1.2), (0.058, 0.7))
"""m under the skin, and sigma in halves of an edge: a lining Gaussian that shows beside the person takes the next."""
THIN = 0.7  # of its depth: a point nearer than this to the skin of another side goes half as deep
FLAT = 0.2  # of its width: how thick a lining Gaussian is
LEAK = 4e-7  # of the person's pixels: a lining Gaussian that paints more beside the person shows there
MUCH = 30.0  # times as much: at last those go that show so much, now that others are gone which hid them


def add_lining(person: Canonical, body: Person, views: Views, frames: list[int]) -> Canonical:
    """The person and, after its rows, the body's own vertices moved inwards and opaque, in the colours above them.

    Where one would show beside the person's masks in `frames` of `views`, it goes deeper, then becomes smaller, and is left
    out at last: there the person is thinner than the body, or the body is beside the person.
    """
    place = torch.zeros(len(body.vertices), dtype=torch.long, device=person.means.device)
    out = len(PLACES)
    for leak, step in [*[(LEAK, 1)] * (out - 1), (LEAK, out), (MUCH * LEAK, out)]:
        rows = (place < out).nonzero()[:, 0]
        both = _with(person, _lining(person, body, rows, place[rows]))
        counts, pixels = count_pixels(both, body, views, frames)
        shown = rows[counts[len(person.means) :, 2] > leak * pixels]
        if not len(shown):
            return both
        place[shown] += step
    rows = (place < out).nonzero()[:, 0]
    return _with(person, _lining(person, body, rows, place[rows]))


def _with(person: Canonical, inner: Canonical) -> Canonical:
    return Canonical(*(torch.cat(pair) for pair in zip(person, inner, strict=True)))


def _lining(person: Canonical, body: Person, rows: Tensor, place: Tensor) -> Canonical:
    """Gaussians under the body's vertices `rows` [M], each at its place[M] of PLACES."""
    vertices, normals = body.vertices[rows], vertex_normals(body.vertices, body.faces)[rows]
    depth, wide = torch.tensor(PLACES).to(vertices)[place].split(1, 1)
    for _ in range(6):
        distance, _ = nearest(body.vertices, vertices - depth * normals, 1)
        depth = torch.where(distance < THIN * depth, 0.5 * depth, depth)
    means, sigmas = vertices - depth * normals, wide * 0.5 * edge_lengths(body.vertices, body.faces)[rows, None]
    opaque = person.opacities >= person.opacities.max().clamp(max=0.5)
    return Canonical(
        means=means,
        rotations=rotation_z_to(normals),
        scales=sigmas * sigmas.new_tensor([1, 1, FLAT]),
        opacities=torch.full_like(means[:, 0], 0.99),
        sh=median_near(person.sh[opaque], person.means[opaque], means, 8)[0],
        weights=body.weights[rows],
    )

"""What of the person stands off the body, found in the training frames before anything is learned."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from stages.avatar.body.hull import Sight, Skin, carve, space_around, surface
from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.body.skinning import skin
from stages.avatar.body.smpl import vertex_normals
from stages.avatar.effects.clothing import Clothing, bones_for
from stages.avatar.kernels.mesh import covered
from stages.avatar.model.person import Surfels
from stages.avatar.splats.neighbours import spread_evenly
from stages.training.views import FittedBody, Views

LOOKED = 60  # frames that carve, at most: more tell little that is new


@torch.no_grad()
def clothed(person: FittedBody, views: Views, frames: list[int], spacing: float) -> FittedBody:
    """A person whose canonical pose is that at rest, with the cloth and hair that most of `frames` show off the body.

    Its points are about `spacing` m apart. Weights are then of the skeleton's bones and of those of the clothes.
    """
    normals = vertex_normals(person.vertices, person.faces)
    body = Skin(*(part.double().cpu().numpy() for part in (person.vertices, normals, person.weights)))
    space = space_around(body)
    carved = carve(space, _sights(person, views, frames))
    if not carved.cloth.any():
        return person
    found = surface(space, body, carved, spacing)
    points, normals, weights, away = (torch.as_tensor(part).to(person.vertices) for part in found[:4])
    hung, weights = bones_for(points, away, weights)
    clothing = Clothing.start(hung, person.joints, person.body_pose[frames])
    sizes = 0.5 * found.spacing * torch.tensor([1, 1, 0.5]).to(points).expand_as(points)
    cloth = Surfels(points, rotation_z_to(normals), sizes, weights)
    own = torch.zeros(len(person.weights), len(clothing)).to(person.weights)
    return person._replace(weights=torch.cat([person.weights, own], 1), clothing=clothing, cloth=cloth)


def _sights(person: FittedBody, views: Views, frames: list[int]) -> Iterator[Sight]:
    """The frames as carving takes them."""
    height, width = views.masks.shape[1:]
    faces = person.faces.cpu().numpy()
    for i in spread_evenly([i for i in frames if person.confidence[i] > 0], LOOKED):
        bones = person.bones(i)
        bones[:, :3, 3] += person.transl[i]
        posed = skin(person.vertices, person.weights, bones)[0]
        parts = (bones, views.viewmats[i], views.Ks[i], posed)
        moved, viewmat, K, vertices = (part.double().cpu().numpy() for part in parts)
        body = covered(vertices, faces, viewmat, K, width, height)
        yield Sight(moved, viewmat, K, views.masks[i].cpu().numpy() / 255, body)

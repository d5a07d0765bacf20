"""What each of a person's Gaussians paints in the frames that it was trained on."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.model.person import Canonical, rest
from stages.avatar.splats.compose import painted_pixels
from stages.avatar.splats.neighbours import nearest
from stages.training.losses import dilated
from stages.training.views import Person, Views, person_frames

EDGE = 0.006  # of the longer side: the width inside an outline where colours are not the person's alone


def count_pixels(person: Canonical, body: Person, views: Views, frames: list[int]) -> tuple[Tensor, float]:
    """How many pixels each Gaussian paints [N,3]: well inside the person's masks, elsewhere, and beside them; and how
    many the masks have: sums over the `person_frames`.

    The first two count only where the skin under a Gaussian faces the camera: the far side shines through the near one.
    """
    bones = body.canonical_bones()
    surface, normals, _ = body.surface()
    outwards = normals[nearest(surface, person.means, 1)[1][:, 0]]
    resting, skin = rest(person, bones), rest(person._replace(rotations=rotation_z_to(outwards)), bones)
    counts, pixels = torch.zeros_like(person.means), 0.0
    for i in person_frames(body, views, frames):
        mask = views.masks[i].float() / 255
        splats, inside = body.posed(resting, i), -dilated(-mask, EDGE)
        paints = painted_pixels(splats, views.viewmats[i], views.Ks[i], torch.stack([inside, 1 - inside, 1 - mask], -1))
        sight = splats.means + views.viewmats[i, :3, :3].T @ views.viewmats[i, :3, 3]  # from the camera's centre
        facing = (body.posed(skin, i).axes[..., 2] * sight).sum(1) < 0
        counts += torch.stack([paints[:, 0] * facing, paints[:, 1] * facing, paints[:, 2]], 1)
        pixels += mask.sum().item()
    return counts, pixels

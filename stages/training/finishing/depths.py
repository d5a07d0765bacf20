"""Puts Gaussians back into the surface, and presses them flat where frames look from one side only and cannot tell their depth."""

from __future__ import annotations

from collections import Counter

import torch
import torch.nn.functional as F
from torch import Tensor

from stages.avatar.model.person import Canonical, rest
from stages.avatar.splats.neighbours import nearest, shares_near
from stages.training.views import FittedBody, Views, person_frames

UNDER = 4  # points of the surface that tell where it is
AROUND = 24  # neighbours over the skin whose middle height is that of the surface, where one side is seen
LEVEL = 8  # of them, those of the most similar height, where more is seen: a hem is a step in the surface
ONE_SIDE = 0.8  # least share of the main sight in all: frames that look from elsewhere, too, tell depth and thickness
OUT, TOLD = 0.001, 0.004  # metres that a Gaussian may stand out, seen from ONE_SIDE, and from more
FACING = 0.5  # least cosine between sight and skin: what is seen edge-on is held by outlines. With 0.3 it costs 0.2 dB
FLAT = 0.0025  # metres across the skin, sigma: a thicker one is a hair at the outline, seen aslant. With 1.5 mm it costs 0.2 dB


@torch.no_grad()
def snap_to_surface(
    person: Canonical, body: FittedBody, views: Views, frames: list[int]
) -> tuple[Canonical, Counter[str]]:
    """Move Gaussians that stand out of the canonical person's surface back along the sights of `frames`; how many `snapped`.

    Those frames see no change; from the side it was a dot off the outline. Along the normal of the skin the same move costs ten
    times as much: only what is proud and seen edge-on goes so. What frames show from ONE_SIDE is pressed FLAT; how many are
    `flattened`.
    """
    surface, outwards, _ = body.surface()
    under, shares = shares_near(surface, person.means, UNDER)
    share = shares[..., None]
    normals = F.normalize((share * outwards[under]).sum(1), dim=1)
    height = ((person.means - (share * surface[under]).sum(1)) * normals).sum(1)
    foot = person.means - height[:, None] * normals
    around = height[nearest(foot, foot, AROUND + 1)[1][:, 1:]]
    level = around.gather(1, (around - height[:, None]).abs().topk(min(LEVEL, around.shape[1]), largest=False).indices)
    sights, alike = _sights(person, body, views, frames)
    facing = (sights * normals).sum(1)
    seen, faces, one_side = alike > 0, facing.abs() > FACING, alike > ONE_SIDE
    off = height - torch.where(one_side, around.median(1).values, level.median(1).values)
    out = off.abs() - torch.where(one_side, OUT, TOLD)
    moved, proud = seen & faces & (out > 0), seen & ~faces & (out > 0) & (off > 0)
    back = torch.where(moved, out * off.sign() / facing, 0)[:, None] * sights
    back += torch.where(proud, out, 0)[:, None] * normals
    person, pressed = _flat(person._replace(means=person.means - back), normals, one_side)
    return person, Counter(snapped=int((moved | proud).sum()), flattened=pressed)


def _flat(person: Canonical, normals: Tensor, which: Tensor) -> tuple[Canonical, int]:
    """The person, of whom those Gaussians [N] are no thicker than FLAT along normals[N,3], and as wide as before across them; also
    how many were thicker.
    """
    axes = person.rotations * person.scales[:, None, :]
    along = (normals[:, None] @ axes)[:, 0]
    less = (1 - FLAT / along.norm(dim=1).clamp_min(1e-12)).clamp_min(0)
    pressed = which & (less > 0)
    axes = (axes - normals[:, :, None] * (less[:, None] * along)[:, None])[pressed]
    turns, sigmas, _ = (found.to(axes) for found in torch.linalg.svd(axes.cpu()))
    rotations, scales = person.rotations.clone(), person.scales.clone()
    rotations[pressed] = turns * torch.linalg.det(turns)[:, None, None].sign()
    scales[pressed] = sigmas
    return person._replace(rotations=rotations, scales=scales), int(pressed.sum())


def _sights(person: Canonical, body: FittedBody, views: Views, frames: list[int]) -> tuple[Tensor, Tensor]:
    """The line [N,3] along which frames mainly look at each Gaussian, in the canonical frame, and its share [N] of all.

    The share is 1 if all look along it, 1/3 if they look from everywhere, 0 if nobody looks.
    """
    turned = person._replace(rotations=torch.eye(3).to(person.rotations).expand_as(person.rotations))
    resting = body.gloved(rest(turned._replace(scales=torch.ones_like(person.scales)), body.canonical_bones()))
    looks = torch.zeros_like(person.rotations)
    for i in person_frames(body, views, frames):
        splats = body.posed(resting, i)
        sight = F.normalize(splats.means + views.viewmats[i, :3, :3].T @ views.viewmats[i, :3, 3], dim=1)
        # transposed, not inverted: a blend of turns is nearly a turn, and may be singular
        sight = F.normalize((splats.axes.mT @ sight[..., None])[..., 0], dim=1)
        looks += sight[:, :, None] * sight[:, None, :]
    shares, lines = (found.to(looks) for found in torch.linalg.eigh(looks.cpu()))  # a GPU would take gigabytes
    return lines[..., -1], shares[:, -1] / shares.sum(1).clamp_min(1e-12)

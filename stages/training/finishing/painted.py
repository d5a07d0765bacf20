"""What each of a person's Gaussians paints in the frames that it was trained on."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.model.person import Canonical, rest
from stages.avatar.rasterize.rendering import BLUR, NEAR
from stages.avatar.splats.compose import painted_pixels
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import nearest
from stages.training.seen import EDGE
from stages.training.step.losses import dilated
from stages.training.views import FittedBody, Views, person_frames


class Painted(NamedTuple):
    """How many pixels each of N Gaussians paints [N], sums over frames: well `inside` the person's masks, at their `edge` or
    out of them, and `beside` them; `along` [N,3] is the mean squared cosine between each axis and the line of sight,
    1 where unseen; `clear` [N] is how much it paints of what it would with nothing before it; `straight` [N] is
    `inside`, each pixel times the squared cosine between its sight and the skin's normal. The masks have so many `pixels`.

    All but `beside` count only where the skin under a Gaussian faces the camera: the far side shines through the near one.
    """

    inside: Tensor
    edge: Tensor
    beside: Tensor
    along: Tensor
    clear: Tensor
    straight: Tensor
    pixels: float


def count_pixels(person: Canonical, body: FittedBody, views: Views, frames: list[int]) -> Painted:
    """What the person's Gaussians paint in the `person_frames` of `frames` of `views`."""
    bones = body.canonical_bones()
    surface, normals, _ = body.surface()
    outwards = normals[nearest(surface, person.means, 1)[1][:, 0]]
    resting = body.gloved(rest(person, bones))
    skin = body.gloved(rest(person._replace(rotations=rotation_z_to(outwards)), bones))
    counts, along, pixels = torch.zeros_like(person.means), torch.zeros_like(person.means), 0.0
    clear, straight = torch.zeros(2, *person.opacities.shape).to(person.opacities)
    for i in person_frames(body, views, frames):
        mask = views.masks[i].float() / 255
        splats, inside = body.posed(resting, i).detach(), -dilated(-mask, EDGE)
        paints = painted_pixels(splats, views.viewmats[i], views.Ks[i], torch.stack([inside, 1 - inside, 1 - mask], -1))
        sight = splats.means + views.viewmats[i, :3, :3].T @ views.viewmats[i, :3, 3]  # from the camera's centre
        out = body.posed(skin, i).axes[..., 2].detach()
        toward = -torch.cosine_similarity(out, sight)
        facing = toward > 0
        counts += torch.stack([paints[:, 0] * facing, paints[:, 1] * facing, paints[:, 2]], 1)
        straight += paints[:, 0] * toward.clamp_min(0).square()
        squares = splats.axes.square().sum(1) * sight.square().sum(1, keepdim=True)
        cosines = (sight[:, None] @ splats.axes)[:, 0].square() / squares
        shown = paints[:, :2].sum(1) * facing
        along += shown[:, None] * cosines
        clear += shown.square() / uncovered_pixels(splats, views.viewmats[i], views.Ks[i]).clamp_min(1e-9)
        pixels += mask.sum().item()
    inside, edge, beside = counts.unbind(1)
    painted = inside + edge
    along = torch.where(painted[:, None] > 0, along / painted[:, None], 1.0)
    return Painted(inside, edge, beside, along, clear / painted.clamp_min(1e-9), straight, pixels)


def uncovered_pixels(splats: Splats, viewmat: Tensor, K: Tensor) -> Tensor:
    """How many pixels [N] of a camera's picture Gaussians would paint with nothing before them.

    The covariance of axes a, b, c, seen along d, has the determinant |(b x c, c x a, a x b) d|^2 (Cauchy-Binet); it is
    larger by 1 / cos^3 where d is aside from the middle of the picture.
    """
    at = splats.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    far, (a, b, c) = at.norm(dim=1), splats.axes.unbind(-1)
    way = ((at / far[:, None]) @ viewmat[:3, :3])[..., None]
    sides = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], 1)
    determinant = (sides @ way).square().sum((1, 2))
    trace = splats.axes.square().sum((1, 2)) - (splats.axes.mT @ way).square().sum((1, 2))
    size = K[0, 0] * K[1, 1] * far / at[:, 2].clamp_min(NEAR) ** 3
    blur = 0.0 if splats.antialias else BLUR  # an antialiased one is as much fainter as it is blurred
    return 2 * math.pi * splats.opacities * (size.square() * determinant + blur * size * trace + blur**2).sqrt()

"""A trained avatar on a body of another shape: its Gaussians go with the skin under them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import Baked, rested
from stages.avatar.splats.neighbours import mean_near

SKIN = 6  # vertices whose mean move a Gaussian follows


class Shapes(NamedTuple):
    """How an avatar changes with the shape of its body, in m per unit of beta: `means` [N,3,10] of its Gaussians, `joints`
    [24,3,10], `centres` [K,3,10] of the bones of its clothes and `fingers` [30,3,10], at rest.
    """

    means: Tensor
    joints: Tensor
    centres: Tensor
    fingers: Tensor


@torch.no_grad()
def shapes_of(avatar: Baked, body: Body, betas: Tensor) -> Shapes:
    """The shapes of an avatar that was learned on a `body` of `betas` [10]: each Gaussian, and each bone of clothes, moves as
    the vertices nearest to it.
    """
    skin, _ = body.rest(betas)
    none = avatar.resting.means[:0]
    centres = none if avatar.clothing is None else avatar.clothing.centres
    fingers = none if avatar.gloves is None else avatar.gloves.joints

    def with_skin(points: Tensor) -> Tensor:
        return mean_near(body.shapedirs, skin, points, SKIN)

    return Shapes(with_skin(avatar.resting.means), body.joint_dirs, with_skin(centres), with_skin(fingers))


def in_shape(avatar: Baked, shapes: Shapes, change: Tensor) -> Baked:
    """The avatar at betas that differ by `change` [10] from its own; differentiable in it. Axes of Gaussians stay as they are."""
    means, joints, centres, fingers = (part @ change for part in shapes)
    clothing, casters, gloves = avatar.clothing, avatar.casters, avatar.gloves
    return rested(avatar, avatar.resting._replace(means=avatar.resting.means + means))._replace(
        joints=avatar.joints + joints,
        clothing=clothing and clothing.moved(avatar.joints + joints, clothing.centres + centres),
        gloves=gloves and gloves._replace(joints=gloves.joints + fingers),
        casters=casters and casters._replace(middles=casters.middles + joints),
    )

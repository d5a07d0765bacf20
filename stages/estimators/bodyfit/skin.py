"""Chosen vertices of the body in all frames of a clip; what they need of the body is looked up once, not at every step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from stages.avatar.body.smpl import Body, rest_relative_transforms


@dataclass(frozen=True)
class Bones:
    """A skeleton in F frames: `betas` [10], `joints` [24,3] m at rest, `turns` [F,24,3,3], `transforms` [F,24,4,4] from rest."""

    betas: Tensor
    joints: Tensor
    turns: Tensor
    transforms: Tensor

    @classmethod
    def of(cls, body: Body, betas: Tensor, turns: Tensor) -> Bones:
        """Of a `body` with `betas` whose joints turn by `turns`, root first."""
        joints = body.rest_joints(betas)
        return cls(betas, joints, turns, rest_relative_transforms(joints, turns, body.parents))


@dataclass(frozen=True)
class Skin:
    """Vertices with indices `vertices` [M], or [F,M] where each frame has its own, and what `Body` knows of them.

    `template` [M,3], `shape` [M,3,10], `correctives` [M,3,P] and `weights` [M,24], with F in front where `vertices` has it.
    """

    vertices: Tensor
    template: Tensor
    shape: Tensor
    correctives: Tensor
    weights: Tensor

    @classmethod
    def of(cls, body: Body, vertices: Tensor) -> Skin:
        """The `vertices` of a `body`."""
        parts = (body.v_template, body.shapedirs, body.posedirs, body.lbs_weights)
        return cls(vertices, *(part[vertices] for part in parts))

    def posed(self, bones: Bones) -> tuple[Tensor, Tensor]:
        """The vertices [F,M,3] m, and the transforms [F,M,3,4] that took them there from rest."""
        points = self.template + self.shape @ bones.betas
        if self.correctives.shape[-1]:
            feature = (bones.turns[:, 1:] - torch.eye(3)).flatten(1)
            points = points + torch.einsum("...mcp,...p->...mc", self.correctives, feature)
        blend = (self.weights @ bones.transforms[:, :, :3].flatten(-2)).unflatten(-1, (3, 4))
        return (blend[..., :3] @ points[..., None])[..., 0] + blend[..., 3], blend

"""A trained avatar: read from its record, and posed without any network."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages import records
from stages.avatar.body.rotations import matrix_from_quat
from stages.avatar.effects.clothing import Clothing
from stages.avatar.model.person import Canonical, Resting, bone_transforms, pose, rest
from stages.avatar.splats.gaussians import Splats


class Baked(NamedTuple):
    """A trained avatar without any network: its Gaussians at rest, its skeleton and its clothes."""

    resting: Resting
    joints: Tensor
    parents: list[int]
    antialias: bool = False
    clothing: Clothing | None = None


def load_avatar(avatar: records.Avatar, device: str | torch.device = "cpu") -> Baked:
    """The avatar's tensors, float32 on `device`, its Gaussians taken back to the rest pose."""

    def to(array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    sh = torch.cat([to(avatar.sh0)[:, None], to(avatar.shN)], 1)
    rotations = matrix_from_quat(to(avatar.quats))
    scales, opacities = to(avatar.scales), to(avatar.opacities)
    person = Canonical(to(avatar.means), rotations, scales, opacities, sh, to(avatar.lbs_weights))
    joints, parents = to(avatar.joints), [int(p) for p in avatar.parents]
    bones = bone_transforms(joints, parents, torch.zeros(3, device=device), to(avatar.canonical_pose))
    clothing = None if avatar.clothes is None else Clothing.of(avatar.clothes, avatar.joints).to(joints)
    bones = bones if clothing is None else clothing.hang(bones)
    return Baked(rest(person, bones), joints, parents, avatar.antialias, clothing)


Pose = tuple[Tensor, Tensor, Tensor]
"""global_orient [3], body_pose [69] rad, transl [3] m."""


def pose_avatar(avatar: Baked, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Splats:
    """The avatar in the world at one pose: global_orient[3], body_pose[69] axis-angle, transl[3] m. No network runs."""
    bones = bones_of(avatar, global_orient, body_pose)
    return pose(avatar.resting, bones, transl)._replace(antialias=avatar.antialias)


def bones_of(avatar: Baked, global_orient: Tensor, body_pose: Tensor) -> Tensor:
    """All bones [J,4,4] from rest to a pose, the skeleton's and those of the clothes, as they swing in it."""
    bones = bone_transforms(avatar.joints, avatar.parents, global_orient, body_pose)
    clothing = avatar.clothing
    return bones if clothing is None else clothing.hang(bones, clothing.swing(body_pose))

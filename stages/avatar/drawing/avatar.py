"""A trained avatar: read from its record, and posed without any network."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages import records
from stages.avatar.body.rotations import matrix_from_quat, matrix_from_rotvec
from stages.avatar.body.skinning import FewBones, without_zeros
from stages.avatar.body.smpl import rest_relative_transforms
from stages.avatar.body.stretch import Stretch, cloth_of, stretch_of
from stages.avatar.effects.clothing import Clothing
from stages.avatar.model.person import Canonical, Resting, bone_transforms, pose, rest
from stages.avatar.splats.gaussians import Splats


class Baked(NamedTuple):
    """A trained avatar without any network: its Gaussians at rest, its skeleton and its clothes.

    `few` are its weights without zeros, None where too many bones move a Gaussian; `stretch` is how cloth grows, if there is any.
    """

    resting: Resting
    joints: Tensor
    parents: list[int]
    antialias: bool = False
    clothing: Clothing | None = None
    few: FewBones | None = None
    stretch: Stretch | None = None


def load_avatar(avatar: records.Avatar, device: str | torch.device = "cpu") -> Baked:
    """The avatar's tensors, float32 on `device`, its Gaussians taken back to the rest pose."""

    def to(array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32)

    def there(parts: Iterable[Tensor]) -> Iterator[Tensor]:
        return (part.to(device) for part in parts)

    sh = torch.cat([to(avatar.sh0)[:, None], to(avatar.shN)], 1)
    rotations, weights = matrix_from_quat(to(avatar.quats)), to(avatar.lbs_weights)
    person = Canonical(to(avatar.means), rotations, to(avatar.scales), to(avatar.opacities), sh, weights)
    joints, parents = to(avatar.joints), [int(p) for p in avatar.parents]
    bones = bone_transforms(joints, parents, torch.zeros(3), to(avatar.canonical_pose))
    clothing = None if avatar.clothes is None else Clothing.of(avatar.clothes, avatar.joints)
    resting = rest(person, bones if clothing is None else clothing.hang(bones))
    few, cloth = without_zeros(weights), cloth_of(resting.means, weights, len(parents))
    return Baked(
        resting=Resting(*there(resting)),
        joints=joints.to(device),
        parents=parents,
        antialias=avatar.antialias,
        clothing=None if clothing is None else clothing.to(device),
        few=few and FewBones(*there(few)),
        stretch=cloth and Stretch(*there(stretch_of(cloth, resting.means, resting.axes))),
    )


Pose = tuple[Tensor, Tensor, Tensor]
"""global_orient [3], body_pose [69] rad, transl [3] m."""


def pose_avatar(avatar: Baked, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Splats:
    """The avatar in the world at one pose: global_orient[3], body_pose[69] axis-angle, transl[3] m. No network runs."""
    return posed_by(avatar, bones_of(avatar, global_orient, body_pose), transl)


def posed_by(avatar: Baked, bones: Tensor, transl: Tensor) -> Splats:
    """The avatar in the world where `bones`[J,4,4], see `bones_of`, and `transl`[3] m take it."""
    return pose(avatar.resting, bones, transl, avatar.few, avatar.stretch)._replace(antialias=avatar.antialias)


def moving(avatar: Baked, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Iterator[Splats]:
    """The avatar in each of P poses, global_orient[P,3], body_pose[P,69], transl[P,3], whose bones are found at once."""
    for bones, there in zip(bones_of(avatar, global_orient, body_pose), transl, strict=True):
        yield posed_by(avatar, bones, there)


def bones_of(avatar: Baked, global_orient: Tensor, body_pose: Tensor) -> Tensor:
    """All bones [...,J,4,4] from rest to poses [...,3] and [...,69], the skeleton's and those of the clothes, as they swing."""
    clothing, joints = avatar.clothing, avatar.joints
    if clothing is None:
        return bone_transforms(joints, avatar.parents, global_orient, body_pose)
    swings, shifts = (clothing.swing(body_pose) * clothing.units).split(3, -1)
    # all turns in one call: calls are what takes long
    vectors = torch.cat([global_orient, body_pose, swings.flatten(-2)], -1).unflatten(-1, (-1, 3))
    turns, swung = matrix_from_rotvec(vectors).split([len(joints), len(clothing)], -3)
    return clothing.swung(rest_relative_transforms(joints, turns, avatar.parents), swung, shifts)

"""A trained avatar: read from its record, and posed without any network."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages import records
from stages.avatar.body.rotations import matrix_from_quat
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.spring import Springs
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
    clothing = None if avatar.clothes is None else Clothing.of(avatar.clothes).to(joints)
    bones = bones if clothing is None else clothing.hang(bones)
    return Baked(rest(person, bones), joints, parents, avatar.antialias, clothing)


Pose = tuple[Tensor, Tensor, Tensor]
"""global_orient [3], body_pose [69] rad, transl [3] m."""


def pose_avatar(avatar: Baked, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Splats:
    """The avatar in the world at one pose: global_orient[3], body_pose[69] axis-angle, transl[3] m. No network runs.

    Clothes hang at rest.
    """
    return next(pose_through(avatar, [(global_orient, body_pose, transl)], [0.0]))


def pose_through(avatar: Baked, poses: Iterable[Pose], times: Iterable[float]) -> Iterator[Splats]:
    """The avatar going through poses at `times` in s, rising: clothes swing on, from rest at the first."""
    for bones, (_, _, transl) in bones_through(avatar, poses, times):
        yield pose(avatar.resting, bones, transl)._replace(antialias=avatar.antialias)


def bones_through(avatar: Baked, poses: Iterable[Pose], times: Iterable[float]) -> Iterator[tuple[Tensor, Pose]]:
    """All bones [J,4,4], the skeleton's and those of the clothes, as `pose_through`; and the poses."""
    clothing = avatar.clothing
    springs = None if clothing is None else Springs(clothing)
    for one, time in zip(poses, times, strict=True):
        orient, body_pose, transl = one
        bones = bone_transforms(avatar.joints, avatar.parents, orient, body_pose)
        if clothing is not None and springs is not None:
            bones = clothing.hang(bones, clothing.swing(body_pose, springs.at(bones, transl, time)))
        yield bones, one

"""A trained avatar: read from its record, and posed without any network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from stages import records
from stages.avatar.body.rotations import matrix_from_quat, matrix_from_rotvec
from stages.avatar.body.skinning import FewBones, without_zeros
from stages.avatar.body.smpl import rest_relative_transforms
from stages.avatar.body.stretch import Stretch, cloth_of, gain_reference, stretch_of
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.shadow import Casters
from stages.avatar.model.person import Canonical, Resting, bone_transforms, pose, rest
from stages.avatar.model.poses import pose_together
from stages.avatar.splats.gaussians import Splats


class Baked(NamedTuple):
    """A trained avatar without any network: its Gaussians at rest, its skeleton and its clothes.

    `few` are its weights without zeros, None where too many bones move a Gaussian; `stretch` is how cloth grows, if there is any.
    `casters` are at rest, None where they are not known.
    """

    resting: Resting
    joints: Tensor
    parents: list[int]
    antialias: bool = False
    clothing: Clothing | None = None
    few: FewBones | None = None
    stretch: Stretch | None = None
    casters: Casters | None = None


def load_avatar(avatar: records.Avatar, device: str | torch.device = "cpu") -> Baked:
    """The avatar's tensors, float32 on `device`, its Gaussians taken back to the rest pose.

    Without normals those of flat Gaussians stand in: their last axes.
    """

    def to(array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32)

    def there(parts: Iterable[Tensor]) -> Iterator[Tensor]:
        return (part.to(device) for part in parts)

    sh = torch.cat([to(avatar.sh0)[:, None], to(avatar.shN)], 1)
    rotations, weights = matrix_from_quat(to(avatar.quats)), to(avatar.lbs_weights)
    normals = rotations[:, :, 2] if avatar.normals is None else to(avatar.normals)
    person = Canonical(to(avatar.means), rotations, to(avatar.scales), to(avatar.opacities), sh, weights, normals)
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
        casters=avatar.casters and Casters(*there(map(to, avatar.casters))),
    )


def rested(avatar: Baked, resting: Resting) -> Baked:
    """The avatar with other Gaussians at rest, as many as before; differentiable in them."""
    stretch = avatar.stretch
    if stretch is not None:  # at rest, cloth gains nothing
        still = gain_reference(resting.axes, resting.means, stretch.rows, stretch.near, -stretch.shares)
        stretch = stretch._replace(axes=still)
    return avatar._replace(resting=resting, stretch=stretch)


def pose_avatar(avatar: Baked, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Splats:
    """The avatar in the world at one pose: global_orient[3], body_pose[69] axis-angle, transl[3] m. No network runs."""
    return posed_by(avatar, bones_of(avatar, global_orient, body_pose), transl)


def posed_by(avatar: Baked, bones: Tensor, transl: Tensor) -> Splats:
    """The avatar in the world where `bones`[J,4,4], see `bones_of`, and `transl`[3] m take it."""
    return pose(avatar.resting, bones, transl, avatar.few, avatar.stretch)._replace(antialias=avatar.antialias)


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


@dataclass(frozen=True)
class PosedAvatar:
    """A `Performer` of P poses, one a frame: global_orient[P,3], body_pose[P,69] axis-angle, transl[P,3] m, on the avatar's device.

    Frames in which the fit trusts its pose are `known` bool[P]; those that show the person are `shows`, None: all.
    """

    avatar: Baked
    global_orient: Tensor
    body_pose: Tensor
    transl: Tensor
    known: np.ndarray | None = None
    shows: Callable[[int], bool] | None = None

    @classmethod
    def of(cls, avatar: Baked, *pose: ArrayLike) -> PosedAvatar:
        """An avatar in the poses [P,3], [P,69] and [P,3], or in one, of [3], [69] and [3]."""
        parts = (torch.as_tensor(np.asarray(part)).to(avatar.joints) for part in pose)
        return cls(avatar, *(torch.atleast_2d(part) for part in parts))

    @cached_property
    def bones(self) -> Tensor:
        """All bones [P,J,4,4] from rest to each pose."""
        return bones_of(self.avatar, self.global_orient, self.body_pose)

    @property
    def joints(self) -> Tensor:
        """The skeleton's joints [P,J,3] m in the world."""
        own = self.bones[:, : len(self.avatar.parents), :3]
        return (own[..., :3] @ self.avatar.joints[..., None])[..., 0] + own[..., 3] + self.transl[:, None]

    def row(self, pose: int) -> PosedAvatar:
        """The person in that pose alone."""
        some = slice(pose, pose + 1)
        return replace(
            self, global_orient=self.global_orient[some], body_pose=self.body_pose[some], transl=self.transl[some]
        )

    def shown(self, frame: int) -> bool:
        """Whether the frame shows the person."""
        return self.shows is None or self.shows(frame)

    def splats(self, frame: int) -> Splats:
        """The person's Gaussians in the world, in even light."""
        return posed_by(self.avatar, self.bones[frame], self.transl[frame])

    def all_splats(self) -> list[Splats]:
        """`splats` of every pose; several, without gradients and in float32 on a CPU, in one pass over the Gaussians."""
        avatar, like = self.avatar, self.avatar.resting.means
        wanted = torch.is_grad_enabled() and any(
            part.requires_grad for part in (self.bones, self.transl, *avatar.resting)
        )
        if len(self.transl) == 1 or wanted or like.dtype != torch.float32 or like.device.type != "cpu":
            return [self.splats(i) for i in range(len(self.transl))]
        posed = pose_together(avatar.resting, self.bones, self.transl, avatar.stretch)
        return [one._replace(antialias=avatar.antialias) for one in posed]

    def casters(self, frame: int) -> Casters:
        """What casts the person's shadow, in the world; ValueError where that is not known."""
        if self.avatar.casters is None:
            raise ValueError("it is not known what of the avatar casts a shadow")
        return self.avatar.casters.posed(self.bones[frame, : len(self.avatar.parents)], self.transl[frame])

    def means(self, frame: int) -> Tensor | None:
        """Means [N,3] m of the Gaussians; None where the pose is not known."""
        return None if self.known is not None and not self.known[frame] else self.splats(frame).means

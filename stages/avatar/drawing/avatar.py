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

from stages import gestures, records
from stages.avatar.body.fingers import finger_bones
from stages.avatar.body.joints import HANDS
from stages.avatar.body.rotations import matrix_from_quat, matrix_from_rotvec
from stages.avatar.body.skinning import FewBones, without_zeros
from stages.avatar.body.smpl import rest_relative_transforms
from stages.avatar.body.stretch import Stretch, cloth_of, gain_reference, stretch_of
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.shadow import Casters
from stages.avatar.model.person import Canonical, Resting, bone_transforms, pose, rest
from stages.avatar.model.poses import pose_together
from stages.avatar.splats.gaussians import Splats


class Gloves(NamedTuple):
    """Fingers as `gestures.Fingers` holds them, as tensors."""

    joints: Tensor
    shape: Tensor
    rows: Tensor
    shares: Tensor

    @classmethod
    def of(cls, fingers: gestures.Fingers, device: str | torch.device) -> Gloves:
        """The tensors of a record, float32 and int64."""
        parts = (torch.as_tensor(part).float() for part in (fingers.joints, fingers.shape, fingers.shares))
        joints, shape, shares = (part.to(device) for part in parts)
        return cls(joints, shape, torch.as_tensor(fingers.rows).long().to(device), shares)

    def weights(self, own: Tensor) -> Tensor:
        """The weights [N,J+30] of Gaussians whose weights without finger bones are `own` [N,J]."""
        weights = torch.cat([own, own.new_zeros(len(own), self.shares.shape[1])], 1)
        hands = weights[self.rows]
        hands[:, own.shape[1] :] = self.shares
        left = hands[:, list(HANDS)] - self.shares.unflatten(1, (2, -1)).sum(2)
        hands[:, list(HANDS)] = left.clamp_min(0)  # a file rounds shares
        weights[self.rows] = hands / hands.sum(1, keepdim=True)
        return weights


def turned_fingers(joints: Tensor, shape: Tensor, hands: Tensor, bones: Tensor) -> Tensor:
    """Finger bones [...,30,4,4] with `joints` [30,3] m from the pose `shape` [2,15,3] to `hands` [...,2,15,3] rad, on a body with
    `bones` [...,J,4,4].
    """
    still = torch.eye(4).to(joints).expand(bones.shape[-3], 4, 4)
    return finger_bones(joints, hands, bones) @ torch.linalg.inv(finger_bones(joints, shape, still))


class Mien(NamedTuple):
    """A face as `gestures.Face` holds it, as tensors: Gaussians `rows` [M] and their `moves` [K,3M] m."""

    rows: Tensor
    moves: Tensor

    @classmethod
    def of(cls, face: gestures.Face, device: str | torch.device) -> Mien:
        """The tensors of a record, float32 and int64."""
        moves = torch.as_tensor(face.moves).float().flatten(1)
        return cls(torch.as_tensor(face.rows).long().to(device), moves.to(device))

    def moved(self, means: Tensor, coefficients: Tensor) -> Tensor:
        """All Gaussians' means [N,3] m at rest with `coefficients` of the first shapes, of all others 0; differentiable in both."""
        far = coefficients @ self.moves[: coefficients.shape[-1]]
        return means.index_add(0, self.rows, far.unflatten(-1, (-1, 3)))


class Baked(NamedTuple):
    """A trained avatar without any network: its Gaussians at rest, its skeleton and its clothes.

    `few` are its weights without zeros, None where too many bones move a Gaussian; `stretch` is how cloth grows, if there is any.
    `casters` are at rest, None where they are not known; so are `gloves` and `face`. Only `gloved` has weights for finger bones.
    """

    resting: Resting
    joints: Tensor
    parents: list[int]
    antialias: bool = False
    clothing: Clothing | None = None
    few: FewBones | None = None
    stretch: Stretch | None = None
    casters: Casters | None = None
    gloves: Gloves | None = None
    face: Mien | None = None

    @property
    def is_gloved(self) -> bool:
        """Whether Gaussians hang on finger bones."""
        own = len(self.parents) + (0 if self.clothing is None else len(self.clothing))
        return self.resting.weights.shape[1] > own


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
        gloves=None if avatar.fingers is None else Gloves.of(avatar.fingers, device),
        face=None if avatar.face is None else Mien.of(avatar.face, device),
    )


def gloved(avatar: Baked) -> Baked:
    """The avatar with weights for its finger bones, the last of all; ValueError where it has none."""
    if avatar.gloves is None:
        raise ValueError("the avatar has no fingers")
    if avatar.is_gloved:
        return avatar
    weights = avatar.gloves.weights(avatar.resting.weights)
    return avatar._replace(resting=avatar.resting._replace(weights=weights), few=without_zeros(weights))


def rested(avatar: Baked, resting: Resting) -> Baked:
    """The avatar with other Gaussians at rest, as many as before; differentiable in them."""
    stretch = avatar.stretch
    if stretch is not None:  # at rest, cloth gains nothing
        still = gain_reference(resting.axes, resting.means, stretch.rows, stretch.near, -stretch.shares)
        stretch = stretch._replace(axes=still)
    return avatar._replace(resting=resting, stretch=stretch)


def posed_by(avatar: Baked, bones: Tensor, transl: Tensor, face: Tensor | None = None) -> Splats:
    """The avatar in the world where `bones`[J,4,4], see `bones_of`, and `transl`[3] m take it, with the coefficients `face`."""
    resting = avatar.resting if face is None else mimed(avatar, face)
    return pose(resting, bones, transl, avatar.few, avatar.stretch)._replace(antialias=avatar.antialias)


def mimed(avatar: Baked, face: Tensor) -> Resting:
    """The Gaussians at rest with coefficients `face` of the first of its shapes; ValueError where the avatar has no face."""
    if avatar.face is None:
        raise ValueError("the avatar has no face that moves")
    return avatar.resting._replace(means=avatar.face.moved(avatar.resting.means, face))


def fingers_of(avatar: Baked, hands: Tensor, bones: Tensor) -> Tensor:
    """Finger bones [...,30,4,4] from where they lie in the avatar to `hands` [...,2,15,3] rad; ValueError where it has none."""
    if avatar.gloves is None:
        raise ValueError("the avatar has no fingers")
    return turned_fingers(avatar.gloves.joints, avatar.gloves.shape, hands, bones)


def bones_of(avatar: Baked, global_orient: Tensor, body_pose: Tensor, hands: Tensor | None = None) -> Tensor:
    """All bones [...,J,4,4] from rest to poses [...,3] and [...,69]: the skeleton's, those of the clothes, as they swing, and where
    an avatar is `gloved` the fingers' in the pose `hands` [...,2,15,3] rad, by default that in which they lie.
    """
    bones = _bones_of(avatar, global_orient, body_pose)
    if hands is None and avatar.gloves is not None and avatar.is_gloved:
        hands = avatar.gloves.shape.expand(*bones.shape[:-3], -1, -1, -1)
    return bones if hands is None else torch.cat([bones, fingers_of(avatar, hands, bones)], -3)


def _bones_of(avatar: Baked, global_orient: Tensor, body_pose: Tensor) -> Tensor:
    """Those of skeleton and clothes."""
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

    Of a `gloved` avatar `hands` [P,2,15,3] rad, of one with a face coefficients `face` [P,K]; without them both stay as they lie.
    Frames in which the fit trusts its pose are `known` bool[P]; those that show the person are `shows`, None: all.
    """

    avatar: Baked
    global_orient: Tensor
    body_pose: Tensor
    transl: Tensor
    known: np.ndarray | None = None
    shows: Callable[[int], bool] | None = None
    hands: Tensor | None = None
    face: Tensor | None = None

    @classmethod
    def of(
        cls, avatar: Baked, *pose: ArrayLike, hands: np.ndarray | None = None, face: np.ndarray | None = None
    ) -> PosedAvatar:
        """An avatar in the poses [P,3], [P,69] and [P,3], or in one, of [3], [69] and [3]; with `hands` [P,2,15,3] and `face`
        [P,K], if it has fingers and a face.
        """
        parts = (torch.as_tensor(part).to(avatar.joints) for part in pose)
        made = cls(avatar, *(torch.atleast_2d(part) for part in parts))
        if hands is not None and avatar.gloves is not None:
            made = replace(made, avatar=gloved(avatar), hands=torch.as_tensor(hands).to(avatar.joints))
        if face is not None and avatar.face is not None:
            made = replace(made, face=torch.as_tensor(face).to(avatar.joints))
        return made

    @cached_property
    def bones(self) -> Tensor:
        """All bones [P,J,4,4] from rest to each pose."""
        return bones_of(self.avatar, self.global_orient, self.body_pose, self.hands)

    @property
    def joints(self) -> Tensor:
        """The skeleton's joints [P,J,3] m in the world."""
        own = self.bones[:, : len(self.avatar.parents), :3]
        return (own[..., :3] @ self.avatar.joints[..., None])[..., 0] + own[..., 3] + self.transl[:, None]

    def row(self, pose: int) -> PosedAvatar:
        """The person in that pose alone."""
        some = slice(pose, pose + 1)
        names = ("global_orient", "body_pose", "transl", "hands", "face")
        rows = {name: part[some] for name in names if (part := getattr(self, name)) is not None}
        return replace(self, **rows)

    def shown(self, frame: int) -> bool:
        """Whether the frame shows the person."""
        return self.shows is None or self.shows(frame)

    def splats(self, frame: int) -> Splats:
        """The person's Gaussians in the world, in even light."""
        face = None if self.face is None else self.face[frame]
        return posed_by(self.avatar, self.bones[frame], self.transl[frame], face)

    def all_splats(self) -> list[Splats]:
        """`splats` of every pose; several, without gradients and in float32 on a CPU, in one pass over the Gaussians."""
        avatar, like = self.avatar, self.avatar.resting.means
        wanted = torch.is_grad_enabled() and any(
            part.requires_grad for part in (self.bones, self.transl, *avatar.resting)
        )
        if (
            len(self.transl) == 1
            or wanted
            or self.face is not None
            or like.dtype != torch.float32
            or like.device.type != "cpu"
        ):
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

"""An avatar in the poses of a take, with all its bones, its clothes and its fingers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from stages import records
from stages.avatar.body.rotations import matrix_from_rotvec, quat_from_matrix
from stages.avatar.drawing.avatar import Baked, PosedAvatar, bones_of
from stages.avatar.splats.factor import factored


def posed(avatar: Baked, take: records.Take) -> Iterator[records.Scene]:
    """The Gaussians at each pose of the take, y up."""
    who = PosedAvatar.of(avatar, *_poses(avatar, take), hands=take.hands)
    for i in range(len(take)):
        yield factored(who.splats(i))


def hung(avatar: Baked, take: records.Take) -> records.Take:
    """The take with the bones of the avatar's clothes, where each of K is in the axes of the joint that it hangs on, and with its
    fingers, if the take moves them.

    Bones that are stretched by those which carry them are made rigid: engines turn and move.
    """
    return _clothed(avatar, _fingered(avatar, take))


def _fingered(avatar: Baked, take: records.Take) -> records.Take:
    if avatar.gloves is None or take.hands is None:
        return take
    lying = matrix_from_rotvec(avatar.gloves.shape).unflatten(1, (5, 3))
    turns = matrix_from_rotvec(torch.as_tensor(take.hands).to(avatar.joints)).unflatten(2, (5, 3))
    first, second = lying[:, :, 0], lying[:, :, 0] @ lying[:, :, 1]
    above = torch.stack([torch.eye(3).to(first).expand_as(first), first, second], 2)
    quats = quat_from_matrix((above @ turns @ lying.mT @ above.mT).flatten(1, 3))
    return replace(take, fingers=quats.cpu().numpy())


def _clothed(avatar: Baked, take: records.Take) -> records.Take:
    clothing = avatar.clothing
    if clothing is None:
        return take
    parents = clothing.carriers.argmax(1)
    bones = bones_of(avatar, *_poses(avatar, take)[:2])
    joint, own = bones[:, parents], bones[:, len(avatar.parents) :]
    turn = joint[..., :3, :3].mT @ own[..., :3, :3]
    left, _, right = torch.linalg.svd(turn)
    centre = (own[..., :3, :3] @ clothing.centres[..., None])[..., 0] + own[..., :3, 3]
    at = (joint[..., :3, :3] @ avatar.joints[parents][..., None])[..., 0] + joint[..., :3, 3]
    step = (joint[..., :3, :3].mT @ (centre - at)[..., None])[..., 0]
    return replace(take, clothes=torch.cat([quat_from_matrix(left @ right), step], -1).cpu().numpy())


def _poses(avatar: Baked, take: records.Take) -> tuple[Tensor, Tensor, Tensor]:
    """global_orient [P,3], body_pose [P,69] rad, transl [P,3] m."""
    quats = take.rotations.reshape(-1, 4)
    turns = Rotation.from_quat(quats, scalar_first=True).as_rotvec().reshape(len(take.rotations), -1)
    steps = take.pelvis - avatar.joints[0].cpu().numpy()
    orient, pose, transl = (torch.as_tensor(part).to(avatar.joints) for part in (turns[:, :3], turns[:, 3:], steps))
    return orient, pose, transl

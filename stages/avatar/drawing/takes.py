"""An avatar in the poses of a take, with all its bones and its clothes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages import records
from stages.avatar.body.rotations import quat_from_matrix
from stages.avatar.drawing.avatar import Baked, Pose, bones_of, pose_avatar
from stages.avatar.splats.factor import factored


def posed(avatar: Baked, take: records.Take) -> Iterator[records.Scene]:
    """The Gaussians at each pose of the take, y up."""
    for pose in _poses(avatar, take):
        yield factored(pose_avatar(avatar, *pose))


def hung(avatar: Baked, take: records.Take) -> records.Take:
    """The take with the bones of the avatar's clothes: where each of K is in the axes of the joint that it hangs on.

    Bones that are stretched by those which carry them are made rigid: engines turn and move.
    """
    clothing = avatar.clothing
    if clothing is None:
        return take
    parents, places = clothing.carriers.argmax(1), []
    for orient, pose, _ in _poses(avatar, take):
        bones = bones_of(avatar, orient, pose)
        joint, own = bones[parents], bones[len(avatar.parents) :]
        turn = joint[:, :3, :3].mT @ own[:, :3, :3]
        left, _, right = torch.linalg.svd(turn)
        centre = (own[:, :3, :3] @ clothing.centres[..., None])[..., 0] + own[:, :3, 3]
        at = (joint[:, :3, :3] @ avatar.joints[parents][..., None])[..., 0] + joint[:, :3, 3]
        step = (joint[:, :3, :3].mT @ (centre - at)[..., None])[..., 0]
        places.append(torch.cat([quat_from_matrix(left @ right), step], 1).cpu().numpy())
    return replace(take, clothes=np.stack(places))


def _poses(avatar: Baked, take: records.Take) -> Iterator[Pose]:
    steps = take.pelvis - avatar.joints[0].cpu().numpy()
    for quats, step in zip(take.rotations, steps, strict=True):
        turns = Rotation.from_quat(quats, scalar_first=True).as_rotvec().reshape(-1)
        orient, pose, transl = (torch.as_tensor(part).to(avatar.joints) for part in (turns[:3], turns[3:], step))
        yield orient, pose, transl

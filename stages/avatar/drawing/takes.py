"""An avatar in the poses of a take, with all its bones and its clothes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages import records
from stages.avatar.drawing.avatar import Baked, pose_avatar
from stages.avatar.splats.factor import factored


def posed(avatar: Baked, take: records.Take) -> Iterator[records.Scene]:
    """The Gaussians at each pose of the take, y up."""
    steps = take.pelvis - avatar.joints[0].cpu().numpy()
    for quats, step in zip(take.rotations, steps, strict=True):
        turns = Rotation.from_quat(quats, scalar_first=True).as_rotvec().reshape(-1)
        parts = (torch.as_tensor(np.asarray(part)).to(avatar.joints) for part in (turns[:3], turns[3:], step))
        yield factored(pose_avatar(avatar, *parts))

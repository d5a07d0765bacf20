"""A baked avatar in many poses at once, in clothes and without."""

import numpy as np
import pytest
import torch

from stages.avatar.body.skinning import of_few_bones
from stages.avatar.drawing.avatar import PosedAvatar, bones_of, load_avatar
from stages.avatar.model.person import bone_transforms
from stages.formats.body_model import read_body_model
from tests.made.clothes import dress, some_clothes
from tests.made.learned import pose_avatar
from tests.made.tiny import make_avatar


@pytest.mark.parametrize("loose", [False, True])
def test_moving_is_each_pose_by_itself(loose, held):
    record = make_avatar(read_body_model(), every=40)
    if loose:
        record = dress(record, some_clothes(12))
        record.lbs_weights[:] = of_few_bones(torch.as_tensor(record.lbs_weights)).numpy()
    avatar, rng = load_avatar(record), np.random.default_rng(2)
    assert avatar.few is not None or not loose
    poses = [torch.as_tensor(rng.normal(0, 0.4, (5, size))).float() for size in (3, 69, 3)]
    posed = PosedAvatar(avatar, *poses)
    together = [posed.splats(i) for i in range(len(poses[2]))]
    assert len(together) == 5 and bones_of(avatar, *poses[:2]).shape == (5, 36 if loose else 24, 4, 4)
    for row, seen in enumerate(together):
        alone = pose_avatar(avatar, *(part[row] for part in poses))
        held((seen.means - alone.means).abs().max(), 1e-5)
        held((seen.axes - alone.axes).abs().max(), 1e-6)
    assert (together[0].means - together[1].means).abs().max() > 0.3


def test_bones_of_clothes_swing_as_in_training(held):
    """`bones_of` finds the turns of body and clothes in one call, training apart."""
    avatar = load_avatar(dress(make_avatar(read_body_model(), every=40), some_clothes(12)))
    pose = torch.as_tensor(np.random.default_rng(3).normal(0, 0.4, 72)).float()
    bones, swing = bone_transforms(avatar.joints, avatar.parents, pose[:3], pose[3:]), avatar.clothing.swing(pose[3:])
    trained, still = avatar.clothing.hang(bones, swing), avatar.clothing.hang(bones)
    assert (trained[24:] - still[24:]).norm(dim=(1, 2)).min() > 0.01
    held((bones_of(avatar, pose[:3], pose[3:]) - trained).abs().max(), 2e-6)

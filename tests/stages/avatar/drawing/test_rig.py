"""The avatar in the T-pose with four bones a Gaussian: the same person, in numbers that engines take as they are."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.avatar.body.rotations import matrix_from_quat
from stages.avatar.body.smpl import DA_POSE
from stages.avatar.body.stretch import STEEPEST
from stages.avatar.drawing.avatar import bones_of, load_avatar, posed_by
from stages.avatar.drawing.rig import rig_of
from stages.avatar.model.person import bone_transforms
from stages.avatar.splats.sh import sh_basis
from stages.formats.body_model import read_body_model
from tests.made.clothes import dress, some_clothes
from tests.made.learned import pose_avatar
from tests.made.tiny import make_avatar


@pytest.fixture(scope="module")
def avatar():
    """Flat, long Gaussians of view-dependent colour, turned every way."""
    plain, rng = make_avatar(read_body_model(), every=40), np.random.default_rng(0)
    n = len(plain)
    more = {
        "quats": rng.normal(size=(n, 4)),
        "scales": rng.uniform(1e-4, 0.05, (n, 3)),
        "shN": rng.normal(size=(n, 15, 3)),
    }
    return replace(plain, **more)


def covariances(quats, scales):
    axes = matrix_from_quat(torch.as_tensor(quats, dtype=torch.float64)).numpy() * scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def test_skinned_with_all_weights_it_is_the_avatar_in_any_pose(avatar):
    rig, pose = rig_of(avatar), torch.as_tensor(np.random.default_rng(1).normal(0, 0.4, 72), dtype=torch.float32)
    posed = pose_avatar(load_avatar(avatar), pose[:3], pose[3:], torch.tensor([0.1, 0.2, 3]))
    bones = bone_transforms(torch.as_tensor(rig.joints), rig.parents.tolist(), pose[:3], pose[3:]).numpy()
    blend = np.einsum("nk,kij->nij", avatar.lbs_weights, bones)
    means = np.einsum("nij,nj->ni", blend[:, :3, :3], rig.means) + blend[:, :3, 3] + [0.1, 0.2, 3]
    np.testing.assert_allclose(means, posed.means.numpy(), atol=1e-5)
    linear = blend[:, :3, :3]
    found = linear @ covariances(rig.quats, rig.scales.astype(float)) @ linear.transpose(0, 2, 1)
    axes = posed.axes.numpy()
    np.testing.assert_allclose(found, axes @ axes.transpose(0, 2, 1), atol=1e-7)


def test_at_the_da_pose_of_the_file_it_stands_in_the_t_pose(avatar):
    rig, at_rest = rig_of(avatar), pose_avatar(load_avatar(avatar), *(torch.zeros(n) for n in (3, 69, 3)))
    np.testing.assert_allclose(rig.means, at_rest.means.numpy(), atol=1e-6)
    assert np.abs(rig.means - avatar.means).max() > 0.3, "legs apart in the file, together here"
    still = rig_of(replace(avatar, canonical_pose=0 * DA_POSE.numpy()))
    np.testing.assert_allclose(still.means, avatar.means, atol=1e-6)
    np.testing.assert_allclose(still.shN, avatar.shN, atol=1e-5)


def test_colours_turn_with_the_legs(avatar):
    """Seen from a direction that turns along with a stiff part, the part has the same colour."""
    stiff = np.flatnonzero(avatar.lbs_weights.max(1) > 0.999)
    turn = load_avatar(avatar).resting.rotations[stiff].double()
    assert (turn - torch.eye(3)).abs().amax() > 0.5
    seen = torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.8]], dtype=torch.float64), dim=1)
    before = sh_basis(seen, 3)[:, 1:] @ torch.as_tensor(avatar.shN[stiff])
    for row, (rig_row, matrix) in enumerate(zip(rig_of(avatar).shN[stiff], turn)):
        after = sh_basis(seen @ matrix.T, 3)[:, 1:] @ torch.as_tensor(rig_row, dtype=torch.float64)
        np.testing.assert_allclose(after, before[row], atol=2e-3)


def test_nobody_is_a_rig_too(avatar):
    rows = ("means", "quats", "scales", "opacities", "sh0", "shN", "lbs_weights")
    rig = rig_of(replace(avatar, **{name: getattr(avatar, name)[:0] for name in rows}))
    assert len(rig) == 0 and rig.bones.shape == (0, 4) and rig.quats.shape == (0, 4)


def test_the_slopes_of_cloth_take_its_gaussians_where_growth_does():
    """As the page does it: a bone that takes a Gaussian elsewhere than its blend draws it by that times its slope."""
    dressed = dress(make_avatar(read_body_model(), every=4), some_clothes(12))
    baked, slopes = load_avatar(dressed), rig_of(dressed).slopes
    pose = torch.as_tensor(np.random.default_rng(1).normal(0, 0.4, 72)).float()
    bones = bones_of(baked, pose[:3], pose[3:])
    posed, plain = posed_by(baked, bones, torch.zeros(3)), posed_by(baked._replace(stretch=None), bones, torch.zeros(3))
    turned = bones[torch.as_tensor(slopes.bones.astype(int)), :3]
    rows = torch.as_tensor(slopes.rows)
    there = (turned[..., :3] @ baked.resting.means[rows, None, :, None])[..., 0] + turned[..., 3]
    growth = (there - posed.means[rows, None]).mT @ torch.as_tensor(slopes.slopes)
    found, gained = growth @ baked.resting.axes[rows], (posed.axes - plain.axes)[rows]
    assert len(rows) > 0.5 * len(dressed) and np.abs(slopes.slopes).max() < 0.5 * STEEPEST
    off = (found - gained).norm(dim=(1, 2)) / gained.norm(dim=(1, 2))
    assert off.median() < 0.1, "up to how weights curve between neighbours"

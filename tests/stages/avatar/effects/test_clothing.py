"""Bones of clothes: at rest they follow the skin, they swing with the pose within limits, and a file keeps them."""

import numpy as np
import pytest
import torch

from stages.avatar.effects.clothing import APART, BONES, FEATURES, Clothing, Hung, bones_for
from stages.avatar.model.person import bone_transforms
from stages.contract import StageError
from stages.formats.clothes import clothes_of
from tests.made.clothes import some_clothes
from tests.made.skeleton import PARENTS


def poses(frames: int = 20) -> torch.Tensor:
    found = torch.zeros(frames, 69)
    found[:, 0] = torch.linspace(-0.6, 0.4, frames)
    found[:, 5] = 0.3 * torch.sin(torch.arange(frames) * 1.0)
    return found


def tube(count: int = 600) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A tube of cloth around two bones side by side: points, distance from the skin, weights of both by distance."""
    generator = torch.Generator().manual_seed(0)
    angle, height = torch.rand(count, generator=generator) * 6.28, torch.rand(count, generator=generator) * 0.6
    points = torch.stack([0.3 * torch.cos(angle), height, 0.3 * torch.sin(angle)], 1)
    weights = torch.zeros(count, 24)
    weights[:, 1] = (points[:, 0] / 0.6 + 0.5).clamp(0, 1)
    weights[:, 2] = 1 - weights[:, 1]
    return points, torch.where(height > 0.5, 0.02, 0.1), weights


@pytest.fixture
def clothing() -> Clothing:
    points, away, weights = tube()
    return Clothing.start(bones_for(points, away, weights)[0], poses())


def skeleton(pose: torch.Tensor) -> torch.Tensor:
    joints = torch.rand(24, 3, generator=torch.Generator().manual_seed(1)).to(pose)
    return bone_transforms(joints, PARENTS, pose.new_tensor([0.1, 0.2, 0.3]), pose)


def test_bones_are_few_apart_and_share_the_cloth_that_is_loose():
    points, away, weights = tube()
    hung, spread = bones_for(points, away, weights)
    assert 4 < len(hung.centres) <= BONES and torch.pdist(hung.centres).min() > APART
    torch.testing.assert_close(spread.sum(1), torch.ones(len(points)))
    assert (spread >= 0).all()
    assert (spread[away == 0.02, 24:] == 0).all() and (spread[away == 0.1, 24:].sum(1) > 0.999).all()
    torch.testing.assert_close(hung.carriers.sum(1), torch.ones(len(hung.centres)))


def test_cloth_on_the_skin_has_no_bones():
    points, _, weights = tube()
    hung, spread = bones_for(points, torch.full_like(points[:, 0], 0.01), weights)
    assert len(hung.centres) == 0 and torch.equal(spread, weights)
    nothing = Clothing.start(hung, poses())
    assert torch.equal(nothing.hang(skeleton(poses()[3]), nothing.swing(poses()[3])), skeleton(poses()[3]))


def test_without_a_swing_a_bone_is_carried_by_its_blend(clothing):
    bones = skeleton(poses()[4])
    for swing in (None, clothing.swing(poses()[4])):
        hung = clothing.hang(bones, swing)
        assert torch.equal(hung[:24], bones)
        torch.testing.assert_close(hung[24:], torch.einsum("kj,jab->kab", clothing.carriers, bones))
    assert clothing.prior().item() == 0


def test_a_swing_turns_about_the_centre_and_shifts_it(clothing):
    bones = torch.eye(4).repeat(24, 1, 1)
    swing = torch.zeros(len(clothing), 6)
    swing[0, 1], swing[1, 3] = 2.0, 1.0
    hung = clothing.hang(bones, swing)[24:]
    centre = torch.cat([clothing.centres, torch.ones(len(clothing), 1)], 1)
    moved = (hung @ centre[..., None])[..., 0][:, :3] - clothing.centres
    torch.testing.assert_close(moved[0], torch.zeros(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(moved[1], torch.tensor([0.05, 0, 0]))
    assert hung[0, 0, 0] == pytest.approx(np.cos(0.6)) and torch.equal(hung[2], torch.eye(4))


def test_no_pose_makes_clothes_explode(clothing):
    torch.nn.init.normal_(clothing.swings, std=0.3)
    wild = torch.full((69,), 40.0)
    most = torch.cat([torch.ones(1), torch.maximum(clothing.low.abs(), clothing.high.abs())])
    assert (clothing.swing(wild).abs() <= clothing.swings.detach().abs() @ most + 1e-5).all()
    held = wild.clone().requires_grad_()
    clothing.features(held).sum().backward()
    assert (held.grad == 0).all(), "beyond what was seen a pose changes nothing more"


def test_gradients_are_right_at_rest_and_in_a_swing():
    hung = Hung(torch.rand(2, 3), torch.rand(2, 24).softmax(1))
    clothing = Clothing.start(hung, poses()).double()
    bones, zero = skeleton(poses()[7]).double(), torch.zeros(len(clothing), 6, dtype=torch.float64)
    for swing in (zero, zero + 0.4):
        torch.autograd.gradcheck(lambda s: clothing.hang(bones, s), swing.requires_grad_(), atol=1e-6)


def test_poses_that_hardly_change_teach_no_feature():
    hung = Hung(torch.rand(3, 3), torch.full((3, 24), 1 / 24))
    for still in (torch.zeros(5, 69), poses()[:1], 1e-7 * torch.randn(6, 69)):
        clothing = Clothing.start(hung, still)
        assert clothing.swings.shape == (3, 6, 1) and clothing.swing(poses()[3]).shape == (3, 6)
    assert Clothing.start(hung, torch.randn(40, 69)).swings.shape == (3, 6, 1 + FEATURES)


def test_a_file_gives_the_same_clothes_back():
    written = some_clothes()
    back = Clothing.of(clothes_of(written.arrays(), "avatar.npz", ""))
    one, other = Clothing.of(written), poses()[4]
    assert torch.equal(back.swing(other), one.swing(other)) and len(back) == len(written) == 5
    assert not any(p.requires_grad for p in back.parameters())


def test_half_of_the_clothes_is_refused():
    whole = some_clothes().arrays()
    assert clothes_of({"means": np.zeros(3)}, "avatar.npz", "") is None
    for name in whole:
        with pytest.raises(StageError, match=name.removeprefix("clothes_")):
            clothes_of({k: v for k, v in whole.items() if k != name}, "avatar.npz", "train again")
        if name not in ("clothes_centres", "clothes_low"):  # which say how many there are
            with pytest.raises(StageError, match="wrong shape"):
                clothes_of(whole | {name: whole[name][:-1]}, "avatar.npz", "train again")

"""Clothes that follow the joints: at rest at first, learned, bounded, and kept in a file."""

import numpy as np
import pytest
import torch

from stages.avatar.effects.clothing import FEATURES, Clothing
from stages.avatar.model.person import Resting
from stages.contract import StageError
from stages.formats.clothes import clothes_of
from stages.records import Clothes

NAMES = ("nodes", "mean", "axes", "low", "high", "offsets")


def someone(count: int = 400, seed: int = 0) -> Resting:
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([0.5, 1.7, 0.3])
    eye = torch.eye(3).repeat(count, 1, 1)
    return Resting(means, eye, torch.ones(count), torch.zeros(count, 1, 3), torch.ones(count, 24) / 24, eye)


def poses(frames: int = 20) -> torch.Tensor:
    found = torch.zeros(frames, 69)
    found[:, 0] = torch.linspace(-0.6, 0.4, frames)
    found[:, 5] = 0.3 * torch.sin(torch.arange(frames) * 1.0)
    return found


@pytest.fixture
def clothing() -> Clothing:
    return Clothing.start(someone().means, poses())


def test_at_first_nothing_moves_in_any_pose(clothing):
    person = someone()
    for pose in (*poses()[:3], torch.full((69,), 3.0)):
        assert torch.equal(clothing(person, pose).means, person.means)
    assert clothing.prior().item() == 0


def test_a_swing_that_follows_a_joint_is_learned_and_holds_in_other_poses(clothing):
    person, seen = someone(), poses()
    skirt = torch.exp(-(((person.means[:, 1] - 0.7) / 0.2) ** 2))[:, None] * torch.tensor([0.0, 0, 0.1])
    adam = torch.optim.Adam([clothing.offsets], lr=1e-3)
    for step in range(100):
        pose = seen[step % len(seen)]
        off = clothing(person, pose).means - person.means - (pose - clothing.mean)[0] * skirt
        adam.zero_grad()
        off.square().sum().backward()
        adam.step()
    other = torch.zeros(69)
    other[0], other[5] = 0.17, -0.11  # in no frame, within them
    wanted = (other - clothing.mean)[0] * skirt  # what clothes do in the mean pose is the person's shape
    off = clothing(person, other).means - person.means - wanted
    assert off.norm() < 0.3 * wanted.norm()


def test_no_pose_makes_clothes_explode(clothing):
    torch.nn.init.normal_(clothing.offsets, std=0.03)
    person, wild = someone(), torch.full((69,), 40.0)
    at_most = torch.maximum(clothing.low.abs(), clothing.high.abs())
    bound = (clothing.offsets.detach().norm(dim=1) @ at_most).max()
    assert (clothing(person, wild).means - person.means).norm(dim=1).max() <= bound
    held = wild.clone().requires_grad_()
    clothing.features(held).sum().backward()
    assert (held.grad == 0).all(), "beyond what was seen a pose changes nothing more"


def test_gradients_are_those_of_a_linear_map():
    clothing = Clothing.start(someone().means, poses()).double()
    torch.nn.init.normal_(clothing.offsets, std=0.03)
    clothing.offsets.requires_grad_(False)
    person = Resting(*(part[:20].double() for part in someone()))
    pose = poses()[7].double().requires_grad_()
    torch.autograd.gradcheck(lambda p: clothing(person, p).means, pose, atol=1e-7)
    middle = clothing.mean.clone().requires_grad_()  # all features 0
    torch.autograd.gradcheck(lambda p: clothing(person, p).means, middle, atol=1e-7)


def test_poses_that_hardly_change_teach_no_feature():
    for still in (torch.zeros(5, 69), poses()[:1], 1e-7 * torch.randn(6, 69)):
        clothing = Clothing.start(someone().means, still)
        assert clothing.offsets.shape[2] == 0
        person = someone()
        assert torch.equal(clothing(person, poses()[3]).means, person.means)
        assert clothing.prior().item() == 0
    assert Clothing.start(someone().means, torch.randn(40, 69)).offsets.shape[2] == FEATURES


def test_far_from_all_nodes_and_on_one_of_them(clothing):
    torch.nn.init.constant_(clothing.offsets, 0.02)
    means = torch.stack([clothing.nodes[0], torch.tensor([50.0, 0, 0]), torch.full((3,), 1e12)])
    weights = clothing.weights(means)
    assert weights.isfinite().all() and weights.sum(1)[0] > 0.99
    assert (weights[1:] == 0).all() and weights.sum(1).max() <= 1


def test_weights_are_kept_for_the_same_means_only(clothing):
    one, other = someone(), someone(seed=1)
    first = clothing.weights(one.means)
    assert clothing.weights(one.means) is first
    assert not torch.equal(clothing.weights(other.means), first)


def test_a_file_gives_the_same_clothes_back(clothing):
    torch.nn.init.normal_(clothing.offsets, std=0.03)
    written = Clothes(**{name: getattr(clothing, name).detach().numpy() for name in NAMES})
    back = Clothing.of(clothes_of(written.arrays(), "avatar.npz", ""))
    person, pose = someone(), poses()[4]
    assert torch.equal(back(person, pose).means, clothing(person, pose).means)
    assert not any(p.requires_grad for p in back.parameters())
    reach = np.maximum(abs(written.low), abs(written.high))
    assert written.largest == pytest.approx(np.linalg.norm(written.offsets * reach, axis=1).max())


def test_half_of_the_clothes_is_refused(clothing):
    whole = Clothes(**{name: getattr(clothing, name).detach().numpy() for name in NAMES}).arrays()
    assert clothes_of({"means": np.zeros(3)}, "avatar.npz", "") is None
    for name in NAMES:
        with pytest.raises(StageError, match=name):
            clothes_of({k: v for k, v in whole.items() if k != f"clothes_{name}"}, "avatar.npz", "train again")
        with pytest.raises(StageError, match="wrong shape"):
            clothes_of(whole | {f"clothes_{name}": whole[f"clothes_{name}"][:-1]}, "avatar.npz", "train again")

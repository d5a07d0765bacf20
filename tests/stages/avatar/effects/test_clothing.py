"""Bones of clothes: legs push them and else they hang, they swing with poses like those of training, and a file keeps them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.avatar.body.joints import HIPS, KNEES
from stages.avatar.body.smpl import Body
from stages.avatar.effects.clothing import APART, BONES, FEATURES, PUSHED, UNLIKE, Clothing, Hung, bones_for
from stages.avatar.model.person import bone_transforms
from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.clothes import clothes_of
from tests.made.clothes import some_clothes
from tests.made.skeleton import PARENTS

LEFT_HIP, LEFT_KNEE = HIPS[0], KNEES[0]


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


JOINTS = torch.rand(24, 3, generator=torch.Generator().manual_seed(1))
FRONT, BACK = 0, 1
AROUND = torch.tensor([0, 1, 0.25, 0.5, 0.75]) * torch.pi  # from straight before, to the left


@pytest.fixture
def clothing() -> Clothing:
    points, away, weights = tube()
    return Clothing.start(bones_for(points, away, weights)[0], JOINTS, poses())


@pytest.fixture(scope="module")
def coat() -> Clothing:
    """Bones before, behind and beside the left hip, at the height of the knee, which the left thigh carries, on the free body."""
    joints = Body(read_body_model(None)).rest(torch.zeros(10))[1]
    carriers = torch.zeros(len(AROUND), 24)
    carriers[:, LEFT_HIP] = 1
    low = torch.stack([joints[LEFT_HIP, 0], joints[LEFT_KNEE, 1], joints[LEFT_HIP, 2]])
    ways = torch.stack([AROUND.sin(), 0 * AROUND, AROUND.cos()], 1)
    return Clothing.start(Hung(low + 0.15 * ways, carriers), joints, poses()).requires_grad_(False)


def skeleton(pose: torch.Tensor, orient=(0.1, 0.2, 0.3), joints=JOINTS) -> torch.Tensor:
    return bone_transforms(joints.to(pose), PARENTS, pose.new_tensor(orient), pose)


def bent(hip: float, knee: float = 0.0, **more) -> torch.Tensor:
    """A pose [69] whose hips and knees are bent by so many radians; forward is negative for hips, back positive for knees."""
    pose = torch.zeros(23, 3, **more)
    pose[[0, 1], 0], pose[[3, 4], 0] = hip, knee
    return pose.flatten()


def test_bones_are_few_apart_and_share_the_cloth_that_is_loose():
    points, away, weights = tube()
    hung, spread = bones_for(points, away, weights)
    assert 4 < len(hung.centres) <= BONES and torch.pdist(hung.centres).min() > APART
    torch.testing.assert_close(spread.sum(1), torch.ones(len(points)))
    assert (spread >= 0).all()
    assert (spread[away == 0.02, 24:] == 0).all() and (spread[away == 0.1, 24:].sum(1) > 0.999).all()
    torch.testing.assert_close(hung.carriers.sum(1), torch.ones(len(hung.centres)))


@pytest.mark.parametrize("size", [0.01, 0.09, 0.35])
def test_bones_are_apart_however_small_the_cloth_is(size):
    points = size * torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    hung, _ = bones_for(points, torch.full((200,), 0.1), torch.eye(24)[torch.zeros(200, dtype=torch.long)])
    gaps = torch.pdist(hung.centres)
    assert len(hung.centres) >= 1 and (gaps > APART).all() and (len(hung.centres) > 1) == (size > 0.1)


def test_cloth_on_the_skin_has_no_bones():
    points, _, weights = tube()
    hung, spread = bones_for(points, torch.full_like(points[:, 0], 0.01), weights)
    assert len(hung.centres) == 0 and torch.equal(spread, weights)
    nothing = Clothing.start(hung, JOINTS, poses())
    assert torch.equal(nothing.hang(skeleton(poses()[3]), nothing.swing(poses()[3])), skeleton(poses()[3]))


def test_without_a_swing_a_bone_is_carried_by_its_blend(clothing):
    clothing.carriers[:, [9, 16]], clothing.carriers[:, :9] = 0.5, 0.0  # no leg
    bones = skeleton(poses()[4])
    for swing in (None, clothing.swing(poses()[4])):
        hung = clothing.hang(bones, swing)
        assert torch.equal(hung[:24], bones)
        torch.testing.assert_close(hung[24:], torch.einsum("kj,jab->kab", clothing.carriers, bones))
    assert clothing.prior().item() == 0


def test_who_stands_as_at_rest_carries_clothes_as_at_rest(clothing):
    bones = skeleton(torch.zeros(69), orient=(0.5, -1.0, 0.8))
    torch.testing.assert_close(clothing.carried(bones), bones[:1].expand(len(clothing), -1, -1))


def test_a_thigh_pushes_the_cloth_before_it_and_does_not_pull_that_behind(coat):
    for hip, pushed in ((-1.2, FRONT), (0.6, BACK)):
        bones = skeleton(bent(hip), (0.0, 0.4, 0.0), coat.joints)
        carried = coat.carried(bones)
        torch.testing.assert_close(carried[pushed], bones[LEFT_HIP])
        torch.testing.assert_close(carried[1 - pushed], coat.upright(bones))


def test_cloth_beside_a_leg_goes_with_it_as_straight_as_the_leg_moves_towards_it(coat):
    for hip in (-0.5, -1.2):
        pushed = coat.pushed(skeleton(bent(hip), (0.0, 0.4, 0.0), coat.joints))[:, LEFT_HIP]
        torch.testing.assert_close(pushed, AROUND.cos().clamp_min(0), atol=1e-3, rtol=0)


@pytest.mark.parametrize("hip", [-1e-4, -1e-3, -0.02, 0.02, 1e-3])
def test_a_thigh_that_hardly_moves_hardly_pushes(coat, hip):
    """As much as it moves, up to PUSHED of its length: what a pose is off by moves no cloth."""
    pushed = coat.pushed(skeleton(bent(hip), (0.0, 0.0, 0.0), coat.joints))[:, LEFT_HIP]
    assert pushed.max() == pytest.approx(abs(np.sin(hip)) / PUSHED, rel=0.05, abs=1e-6)


def test_cloth_goes_over_from_hanging_to_the_leg_without_a_jump(coat):
    bends = torch.linspace(-0.5, 0.5, 201)
    carried = torch.stack([coat.carried(skeleton(bent(hip), joints=coat.joints)) for hip in bends.tolist()])
    at = (carried[..., :3, :3] @ coat.centres[..., None])[..., 0] + carried[..., :3, 3]
    assert at.diff(dim=0).norm(dim=-1).max() < 0.012, (
        "a step is 0.005 rad, half a metre below the hip, and the push grows"
    )


def test_who_squats_has_clothes_that_hang_down(coat):
    """The pelvis leans forward by 40 degrees, the knees are bent, and the ankles are below the trunk."""
    bones = skeleton(bent(-1.7, 1.6), (0.7, 0.0, 0.0), coat.joints)
    turned = coat.upright(bones)[:3, :3]
    torch.testing.assert_close(turned @ turned.T, torch.eye(3), atol=1e-5, rtol=0)
    down = coat.carried(bones)[BACK, :3, :3] @ torch.tensor([0.0, -1, 0])
    leaning = bones[0, :3, :3] @ torch.tensor([0.0, -1, 0])
    assert down[1] < -0.999 and leaning[1] > -0.8


def test_who_is_folded_or_upside_down_has_clothes_that_are_finite(coat):
    ankles = coat.joints[[7, 8]].mean(0)
    curled = torch.eye(4).repeat(24, 1, 1)
    curled[[7, 8], :3, 3] = coat.joints[[0, 9]].mean(0) - ankles  # between the ankles is where the trunk is
    torch.testing.assert_close(coat.upright(curled), curled[0])
    over = torch.eye(4).repeat(24, 1, 1)
    over[[7, 8], :3, 3] = 2 * (coat.joints[[0, 9]].mean(0) - ankles)  # the ankles are above
    for bones in (curled, over):
        bones = bones.clone().requires_grad_()
        carried = coat.carried(bones)
        (grad,) = torch.autograd.grad(carried.square().sum(), bones)
        assert grad.isfinite().all() and carried.isfinite().all() and carried.abs().max() < 4


def test_a_swing_turns_about_the_centre_and_shifts_it(clothing):
    bones = torch.eye(4).repeat(24, 1, 1)
    swing = torch.zeros(len(clothing), 6)
    swing[0, 1], swing[1, 3] = 2.0, 1.0
    hung = clothing.hang(bones, swing)[24:]
    centre = torch.cat([clothing.centres, torch.ones(len(clothing), 1)], 1)
    moved = (hung @ centre[..., None])[..., 0][:, :3] - clothing.centres
    torch.testing.assert_close(moved[0], torch.zeros(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(moved[1], torch.tensor([0.05, 0, 0]))
    assert hung[0, 0, 0] == pytest.approx(np.cos(0.6))
    torch.testing.assert_close(hung[2], torch.eye(4))


def beyond(clothing: Clothing, share: float) -> torch.Tensor:
    """A pose whose first feature is beyond what training saw, by so much of it; the others are as on the mean."""
    feature = clothing.high[0] + share * (clothing.high[0] - clothing.low[0])
    return clothing.mean + feature * torch.linalg.pinv(clothing.axes)[0]


def test_a_pose_unlike_those_of_training_has_the_mean_swing(clothing):
    torch.nn.init.normal_(clothing.swings, std=0.3)
    mean = clothing.swings.detach()[..., 0]
    for pose in (beyond(clothing, UNLIKE + 0.01), torch.full((69,), 40.0)):
        held = pose.clone().requires_grad_()
        assert torch.equal(clothing.swing(held), mean)
        clothing.features(held).sum().backward()
        assert (held.grad == 0).all(), "from there on a pose changes nothing more"


def test_a_swing_fades_to_the_mean_one_without_a_jump(clothing):
    torch.nn.init.normal_(clothing.swings, std=0.3)
    swing = torch.stack([clothing.swing(beyond(clothing, share)) for share in torch.linspace(-1, 1, 401).tolist()])
    assert swing.diff(dim=0).abs().max() < 0.06 * (swing - clothing.swings[..., 0]).abs().max()
    edge, half = clothing.features(beyond(clothing, 0.0)), clothing.features(beyond(clothing, UNLIKE / 2))
    torch.testing.assert_close(half[1:], edge[1:] / 2)
    assert edge[1] == pytest.approx(clothing.high[0].item(), rel=1e-5)


def test_limits_of_a_file_that_meet_leave_the_mean_swing():
    written = some_clothes()
    clothing = Clothing.of(replace(written, high=written.low), JOINTS)
    pose = poses()[4].clone().requires_grad_()
    features = clothing.features(pose)
    (grad,) = torch.autograd.grad(features.sum(), pose)
    assert features[0] == 1 and (features[1:] == 0).all() and grad.isfinite().all()


def test_gradients_are_right_at_rest_and_in_a_swing():
    hung = Hung(torch.rand(2, 3), torch.rand(2, 24).softmax(1))
    clothing = Clothing.start(hung, JOINTS, poses()).double()
    bones, zero = skeleton(poses()[7]).double(), torch.zeros(len(clothing), 6, dtype=torch.float64)
    for swing in (zero, zero + 0.4):
        torch.autograd.gradcheck(lambda s: clothing.hang(bones, s), swing.requires_grad_(), atol=1e-6)


def test_gradients_of_a_pose_are_right_where_a_leg_pushes_a_little_and_where_all_the_way(coat):
    clothing = Clothing.of(replace(some_clothes(2), centres=coat.centres[:2]), coat.joints).double()
    for hip in (-0.1, -0.8, 0.4):
        pose = bent(hip, 0.3, dtype=torch.float64) + 0.01
        held = pose.requires_grad_()
        torch.autograd.gradcheck(lambda p: clothing.carried(skeleton(p, joints=clothing.joints)), held, atol=1e-6)


def test_gradients_of_features_are_right_within_beyond_and_far_beyond_what_training_saw(clothing):
    clothing = clothing.double()
    for share in (-0.4, 0.2 * UNLIKE, 0.8 * UNLIKE, 2 * UNLIKE):
        torch.autograd.gradcheck(clothing.features, beyond(clothing, share).requires_grad_(), atol=1e-6)


def test_poses_that_hardly_change_teach_no_feature():
    hung = Hung(torch.rand(3, 3), torch.full((3, 24), 1 / 24))
    for still in (torch.zeros(5, 69), poses()[:1], 1e-7 * torch.randn(6, 69)):
        clothing = Clothing.start(hung, JOINTS, still)
        assert clothing.swings.shape == (3, 6, 1) and clothing.swing(poses()[3]).shape == (3, 6)
    assert Clothing.start(hung, JOINTS, torch.randn(40, 69)).swings.shape == (3, 6, 1 + FEATURES)


def test_a_file_gives_the_same_clothes_back():
    written = some_clothes()
    back = Clothing.of(clothes_of(written.arrays(), "avatar.npz", ""), JOINTS)
    one, other = Clothing.of(written, JOINTS), poses()[4]
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

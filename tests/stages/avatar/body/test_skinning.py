"""Skinning: points and covariances follow the bones, and weights come from the nearest vertices."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.skinning import (
    MOST,
    WEIGHT_GAP,
    WORDS,
    all_bones,
    heaviest,
    knn_weights,
    of_few_bones,
    skin,
    without_zeros,
)
from stages.avatar.body.smpl import DA_POSE, Body
from stages.avatar.model.person import bone_transforms

F64 = torch.float64


def da_transforms(body: Body, joints: torch.Tensor) -> torch.Tensor:
    return bone_transforms(joints, body.parents, joints.new_zeros(3), DA_POSE.to(joints))


@pytest.fixture
def posed(small_body):
    body = Body(small_body(posedirs=False), F64)
    g = torch.Generator().manual_seed(0)
    betas, orient, pose = (torch.randn(n, dtype=F64, generator=g) * 0.5 for n in (10, 3, 69))
    vertices, joints = body.rest(betas)
    da = da_transforms(body, joints)
    canonical = skin(vertices, body.lbs_weights, da)[0]
    return body, betas, orient, pose, joints, da, canonical


def test_canonical_vertices_go_where_the_body_goes(small_body):
    """True for one-bone vertices; blended ones differ, because blending and inverting do not commute."""
    model = small_body(posedirs=False)
    model = replace(model, lbs_weights=np.eye(24)[model.lbs_weights.argmax(1)])
    body = Body(model, F64)
    g = torch.Generator().manual_seed(0)
    betas, orient, pose = (torch.randn(n, dtype=F64, generator=g) * 0.5 for n in (10, 3, 69))
    vertices, joints = body.rest(betas)
    da = da_transforms(body, joints)
    bones = bone_transforms(joints, body.parents, orient, pose) @ torch.linalg.inv(da)
    moved = skin(skin(vertices, body.lbs_weights, da)[0], body.lbs_weights, bones)[0]
    assert torch.allclose(moved, body(betas, orient[None], pose[None], torch.zeros(1, 3).double())[0][0], atol=1e-12)


def test_e03_points_move_with_all_bones(posed, held):
    body, _, _, _, _, _, canonical = posed
    bones = torch.eye(4, dtype=torch.float32).repeat(24, 1, 1)
    bones[:, 0, 3] = 1e3
    points, _ = skin(canonical.float(), body.lbs_weights.float(), bones)
    held(((points[:, 0].double() - canonical[:, 0]) / 1e3 - 1).abs().max(), 1e-6)


@pytest.mark.parametrize("turns", [[(0, 0, 0), (0, 0, math.pi)], [(math.pi, 0, 0), (0, math.pi, 0), (0, 0, math.pi)]])
def test_e11_e13_d14_blends_without_rotation_keep_value_and_gradient(turns):
    """A twist of 180 degrees is singular, three half turns mirror; T M M^T T^T is finite, and exact, for both."""
    bones = torch.eye(4).repeat(24, 1, 1)
    rotvec = torch.tensor(turns, requires_grad=True)
    bones = torch.cat([torch.stack([torch.block_diag(m, torch.ones(1)) for m in matrix_from_rotvec(rotvec)]), bones])
    weights = torch.zeros(1, 24)
    weights[0, : len(turns)] = 1 / len(turns)
    axes = torch.diag(torch.tensor([0.02, 0.02, 0.002]))
    _, linear = skin(torch.zeros(1, 3), weights, bones[:24])
    assert torch.allclose(
        linear[0], torch.diag(torch.tensor([0.0, 0, 1]) if len(turns) == 2 else -torch.ones(3) / 3), atol=1e-6
    )
    covariance = (linear @ axes) @ (linear @ axes).mT
    assert (torch.linalg.eigvalsh(covariance.double()) > -1e-12).all()
    covariance.sum().backward()
    assert rotvec.grad.isfinite().all() and rotvec.grad.abs().max() > 1e-6


@pytest.mark.parametrize("degrees", [0, 30, 60, 90, 120, 180])
def test_e12_a_bent_elbow_takes_the_covariance_of_its_blend(degrees, held):
    """Half of a bone at rest, half of one turned: as a quaternion it would be 66 % wrong at 90 degrees; smooth to 180."""
    axes = matrix_from_rotvec(torch.tensor([0.3, -0.2, 0.5])) @ torch.diag(torch.tensor([0.02, 0.02, 0.002]))
    truth, found, grads = [], [], []
    for dtype in (torch.float32, F64):
        angle = torch.tensor([0, 0, math.radians(degrees)], dtype=dtype, requires_grad=True)
        bones = torch.eye(4, dtype=dtype).repeat(24, 1, 1)
        bones = torch.cat([torch.block_diag(matrix_from_rotvec(angle), torch.ones(1))[None].to(dtype), bones[1:]])
        weights = torch.zeros(1, 24, dtype=dtype)
        weights[0, :2] = 0.5
        _, linear = skin(torch.zeros(1, 3, dtype=dtype), weights, bones)
        moved = linear[0] @ axes.to(dtype)
        found.append(moved @ moved.T)
        grads.append(torch.autograd.grad((found[-1] * torch.arange(9.0).view(3, 3)).sum(), angle)[0])
    turn = math.radians(degrees)
    B = (
        np.eye(3) + np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    ) / 2
    sigma = axes.double().numpy() @ axes.double().numpy().T
    truth = torch.from_numpy(B @ sigma @ B.T)
    held((found[0] - truth).norm() / truth.norm(), 1e-6)
    held((found[1] - truth).norm() / truth.norm(), 1e-14)
    assert grads[1].norm() > 1e-6
    held((grads[0] - grads[1]).norm() / grads[1].norm(), 1e-5)


def test_e10_across_the_gap_between_two_limbs_the_weight_changes_once():
    """Two cylinders 1 mm apart that move with other bones: from one to the other, and nowhere back."""
    angle = torch.linspace(0, 2 * math.pi, 61)[:-1]
    ring = torch.stack([0.05 * angle.cos(), 0.05 * angle.sin(), 0 * angle], 1)
    rings = torch.cat([ring + torch.tensor([0, 0, z]) for z in torch.linspace(-0.1, 0.1, 21)])
    vertices = torch.cat([rings - torch.tensor([0.0505, 0, 0]), rings + torch.tensor([0.0505, 0, 0])])
    weights = torch.zeros(len(vertices), 24)
    weights[: len(rings), 3], weights[len(rings) :, 7] = 1, 1
    points = torch.linspace(-0.06, 0.06, 2401)[:, None] * torch.tensor([1.0, 0.02, 0.01])
    share = knn_weights(points, vertices, weights)[:, 7]
    assert share[0] == 0 and share[-1] == 1 and (share[1:] >= share[:-1]).all()
    assert points[share > 0.5][0, 0].abs() < 1e-4, "and in the middle"


def test_c01_gradients(posed):
    body, _, orient, pose, joints, da, canonical = posed
    inputs = [x.clone().requires_grad_() for x in (canonical[:2], body.lbs_weights[:2], orient, pose)]

    def run(points, weights, orient, pose):
        return skin(points, weights, bone_transforms(joints, body.parents, orient, pose) @ torch.linalg.inv(da))

    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-7, fast_mode=True)


def naive(points, vertices, weights, k):
    """The formula in float64 with a double loop and Python's big exponents by mpmath-free shifting."""
    rows = []
    for p in points.double().numpy():
        d = np.linalg.norm(vertices.double().numpy() - p, axis=1)
        near = np.argsort(d, kind="stable")[:k]
        w = weights.double().numpy()[near]
        keep = np.abs(w - w[0]).sum(1) < WEIGHT_GAP
        e = np.exp(-(d[near] ** 2) + d[near[0]] ** 2) * keep
        rows.append((e[:, None] * w).sum(0) / e.sum())
    return torch.tensor(np.array(rows))


@pytest.fixture
def skinned_cloud():
    g = torch.Generator().manual_seed(1)
    vertices = torch.rand(300, 3, generator=g)
    weights = torch.zeros(300, 24)
    side = (vertices[:, 0] > 0.5).float()
    weights[:, 3], weights[:, 7] = 1 - side, side
    weights += 0.0005 * torch.rand(300, 24, generator=g) / 24
    return vertices, weights / weights.sum(1, keepdim=True)


@pytest.mark.parametrize("away", [0.0, 1.5, 20.0, 1000.0])
def test_e04_e06_neighbour_weights_near_and_far(skinned_cloud, away, held):
    vertices, weights = skinned_cloud
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(2)) + torch.tensor([away, 0, 0])
    found = knn_weights(points, vertices, weights)
    assert torch.allclose(found.sum(1), torch.ones(40), atol=1e-6)
    held((found - naive(points, vertices, weights, 6)).abs().max(), 1e-6)
    leaves = [t.clone().requires_grad_() for t in (points, vertices, weights)]
    assert not knn_weights(*leaves).requires_grad, "a reference that moves with what it judges pulls nowhere"


def test_e07_on_a_vertex_among_others_of_another_limb(skinned_cloud, held):
    vertices, weights = skinned_cloud
    vertices, weights = vertices.clone(), weights.clone()
    vertices[1:7] = vertices[0] + 1e-3 * torch.randn(6, 3, generator=torch.Generator().manual_seed(0))
    weights[0] = torch.eye(24)[20]
    held((knn_weights(vertices[:1].clone(), vertices, weights) - weights[:1]).abs().max(), 1e-6)


def test_e05_e07_coincident_vertices_and_ties():
    vertices = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    weights = torch.eye(24)[[5, 5, 5, 5, 5, 5]]
    found = knn_weights(torch.zeros(1, 3), vertices, weights)
    assert torch.allclose(found, weights[:1])
    far = knn_weights(torch.tensor([[0.3, 0.2, 9.0]]), vertices, weights)
    assert torch.allclose(far, weights[:1]), "between vertices that move alike, distance decides nothing"


def test_e09_neighbours_are_exact_far_from_the_origin(skinned_cloud):
    vertices, weights = skinned_cloud
    for offset in (0.0, 100.0, 1000.0):
        moved = vertices.double() + offset
        assert torch.equal(
            knn_weights(moved, moved, weights.double(), k=1), weights.double() / weights.double().sum(1, True)
        )


def test_e08_refuses_what_has_no_answer(skinned_cloud):
    vertices, weights = skinned_cloud
    with pytest.raises(ValueError, match="7 nearest of 5"):
        knn_weights(vertices, vertices[:5], weights[:5], k=7)
    with pytest.raises(ValueError, match="0 nearest"):
        knn_weights(vertices, vertices, weights, k=0)
    with pytest.raises(ValueError, match="6 nearest of 0"):
        knn_weights(vertices, vertices[:0], weights[:0])
    broken = vertices.clone()
    broken[4, 1] = math.nan
    with pytest.raises(ValueError, match=r"\b4\b.*finite"):
        knn_weights(broken, vertices, weights)


def test_few_bones_are_the_heaviest_in_their_proportions():
    weights = torch.as_tensor(np.random.default_rng(3).dirichlet(np.full(30, 0.3), 500))
    found = of_few_bones(weights)
    kept, order = found > 0, weights.sort(1, descending=True)
    assert (kept.sum(1) <= MOST).all() and kept.sum(1).max() == MOST
    assert torch.equal(found.argmax(1), order.indices[:, 0])
    torch.testing.assert_close(found, torch.where(kept, weights, 0) / order.values[:, :MOST].sum(1, keepdim=True))
    torch.testing.assert_close(found.sum(1), torch.ones(500, dtype=torch.float64))
    narrow = torch.tensor([[0.25, 0.75, 0.0]])
    assert torch.equal(of_few_bones(narrow), narrow)


def test_bytes_of_weights_add_up_and_are_nearest():
    rng = np.random.default_rng(2)
    weights = rng.dirichlet(np.full(24, 0.1), 2000)
    weights[0] = np.eye(24)[7]
    weights[1] = 1 / 24
    bones, bytes_, kept = heaviest(weights)
    assert bones.dtype == bytes_.dtype == np.uint8 and (bytes_.astype(int).sum(1) == 255).all()
    assert bones[0].tolist() == [7, 0, 0, 0] and bytes_[0].tolist() == [255, 0, 0, 0] and kept[0] == 1
    assert bones[1].tolist() == [0, 1, 2, 3] and kept[1] == pytest.approx(4 / 24)
    assert (np.diff(bytes_.astype(int), axis=1) <= 0).all(), "heaviest first"
    exact = np.take_along_axis(weights, bones.astype(int), 1) / kept[:, None] * 255
    assert np.abs(np.where(bytes_ > 0, exact - bytes_, 0)).max() < 1
    back = all_bones(bones, bytes_, 24)
    np.testing.assert_allclose(back.sum(1), 1)
    assert np.abs(back * kept[:, None] - weights)[kept > 0.999].max() < 1 / 255 + 1e-3
    words = heaviest(weights, 8, WORDS)[1]
    assert words.dtype == np.uint16 and (words.astype(int).sum(1) == 65535).all()
    assert back[0, 7] == 1, "a bone without weight is bone 0, and takes nothing from it"


@pytest.fixture
def many_bones():
    """30 bones, of which each of 40 points has 1 to MOST."""
    g = torch.Generator().manual_seed(5)
    weights = of_few_bones(torch.rand(40, 30, generator=g, dtype=F64).pow(4).softmax(1))
    weights[0], weights[1, weights[1].argsort()[:-3]] = torch.eye(30)[17], 0
    weights = weights / weights.sum(1, keepdim=True)
    return torch.rand(40, 3, generator=g, dtype=F64), weights, torch.randn(30, 4, 4, generator=g, dtype=F64)


def test_without_zeros_weights_skin_the_same(many_bones, held):
    points, weights, bones = many_bones
    few = without_zeros(weights)
    assert few.which.shape == few.shares.shape == (40, MOST)
    found = []
    for given in (weights, few):
        leaf, at = bones.clone().requires_grad_(), points.clone().requires_grad_()
        moved, linear = skin(at, given, leaf)
        (moved.sin().sum() + (linear * torch.arange(9.0).view(3, 3)).sin().sum()).backward()
        found.append((moved.detach(), linear.detach(), leaf.grad, at.grad))
    for dense, sparse in zip(*found):
        assert dense.abs().max() > 0.1
        held((dense - sparse).abs().max() / dense.abs().max(), 2e-15)
    assert torch.autograd.gradcheck(lambda b: skin(points, few, b), bones.requires_grad_(), atol=1e-7)


def test_weights_of_more_bones_or_of_nobody_stay_as_they_are(many_bones):
    _, weights, _ = many_bones
    weights[7, :9] = 0.1
    assert (weights[7] != 0).sum() > MOST and without_zeros(weights) is None
    assert without_zeros(weights[:0]) is None and without_zeros(torch.zeros(3, 24)) is None

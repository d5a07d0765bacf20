import math

import numpy as np
import pytest
import torch

from stages.avatar.body import Body
from stages.avatar.rotations import matrix_from_rotvec
from stages.avatar.skinning import WEIGHT_GAP, canonical_to_posed, knn_weights, skin

F64 = torch.float64


@pytest.fixture
def posed(small_body):
    body = Body(small_body(posedirs=False), F64)
    g = torch.Generator().manual_seed(0)
    betas, orient, pose = (torch.randn(n, dtype=F64, generator=g) * 0.5 for n in (10, 3, 69))
    vertices, joints = body.rest(betas)
    da = body.da_transforms(joints)
    canonical = skin(vertices, body.lbs_weights, da)[0]
    return body, betas, orient, pose, joints, da, canonical


def test_canonical_vertices_go_where_the_body_goes(small_body):
    """True for one-bone vertices; blended ones differ, because blending and inverting do not commute."""
    model = small_body(posedirs=False)
    model.lbs_weights = np.eye(24)[model.lbs_weights.argmax(1)]
    body = Body(model, F64)
    g = torch.Generator().manual_seed(0)
    betas, orient, pose = (torch.randn(n, dtype=F64, generator=g) * 0.5 for n in (10, 3, 69))
    vertices, joints = body.rest(betas)
    da = body.da_transforms(joints)
    bones = canonical_to_posed(body.joint_transforms(joints, orient, pose), da)
    moved = skin(skin(vertices, body.lbs_weights, da)[0], body.lbs_weights, bones)[0]
    assert torch.allclose(moved, body(betas, orient[None], pose[None], torch.zeros(1, 3).double())[0][0], atol=1e-12)


def test_canonical_pose_in_is_canonical_out(posed):
    body, _, _, _, _, da, canonical = posed
    bones = canonical_to_posed(da, da)
    points, linear = skin(canonical, body.lbs_weights, bones)
    assert torch.allclose(points, canonical, atol=1e-12)
    assert torch.allclose(linear, torch.eye(3, dtype=F64).expand_as(linear), atol=1e-12)


def test_inverse_is_the_true_inverse(posed):
    body, _, orient, pose, joints, da, _ = posed
    transforms = body.joint_transforms(joints, orient, pose)
    assert torch.allclose(canonical_to_posed(transforms, da), transforms @ torch.linalg.inv(da), atol=1e-12)


def test_points_move_with_all_bones(posed):
    body, _, _, _, _, _, canonical = posed
    bones = torch.eye(4, dtype=torch.float32).repeat(24, 1, 1)
    bones[:, 0, 3] = 1e3
    points, _ = skin(canonical.float(), body.lbs_weights.float(), bones)
    assert torch.allclose(points[:, 0] - canonical[:, 0].float(), torch.full((60,), 1e3), rtol=1e-6)


@pytest.mark.parametrize("turns", [[(0, 0, 0), (0, 0, math.pi)], [(math.pi, 0, 0), (0, math.pi, 0), (0, 0, math.pi)]])
def test_blends_without_rotation_keep_value_and_gradient(turns):
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
    assert rotvec.grad.isfinite().all()


def test_gradients(posed):
    body, _, orient, pose, joints, da, canonical = posed
    inputs = [x.clone().requires_grad_() for x in (canonical[:2], body.lbs_weights[:2], orient, pose)]

    def run(points, weights, orient, pose):
        return skin(points, weights, canonical_to_posed(body.joint_transforms(joints, orient, pose), da))

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
def test_neighbour_weights_near_and_far(skinned_cloud, away):
    vertices, weights = skinned_cloud
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(2)) + torch.tensor([away, 0, 0])
    found = knn_weights(points, vertices, weights)
    assert torch.allclose(found.sum(1), torch.ones(40), atol=1e-6)
    assert torch.allclose(found.double(), naive(points, vertices, weights, 6), atol=1e-6)
    assert not found.requires_grad


def test_on_a_vertex_among_others_of_another_limb(skinned_cloud):
    vertices, weights = skinned_cloud
    vertices, weights = vertices.clone(), weights.clone()
    vertices[1:7] = vertices[0] + 1e-3 * torch.randn(6, 3, generator=torch.Generator().manual_seed(0))
    weights[0] = torch.eye(24)[20]
    assert torch.allclose(knn_weights(vertices[:1].clone(), vertices, weights), weights[:1], atol=1e-6)


def test_coincident_vertices_and_ties():
    vertices = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    weights = torch.eye(24)[[5, 5, 5, 5, 5, 5]]
    found = knn_weights(torch.zeros(1, 3), vertices, weights)
    assert torch.allclose(found, weights[:1])


def test_neighbours_are_exact_far_from_the_origin(skinned_cloud):
    vertices, weights = skinned_cloud
    for offset in (0.0, 100.0, 1000.0):
        moved = vertices.double() + offset
        assert torch.equal(
            knn_weights(moved, moved, weights.double(), k=1), weights.double() / weights.double().sum(1, True)
        )


def test_refuses_what_has_no_answer(skinned_cloud):
    vertices, weights = skinned_cloud
    with pytest.raises(ValueError, match="7 nearest of 5"):
        knn_weights(vertices, vertices[:5], weights[:5], k=7)
    with pytest.raises(ValueError, match="0 nearest"):
        knn_weights(vertices, vertices, weights, k=0)
    broken = vertices.clone()
    broken[4, 1] = math.nan
    with pytest.raises(ValueError, match="point 4 is not finite"):
        knn_weights(broken, vertices, weights)

"""The body agrees with SMPL by the book, and its vertices, joints, landmarks and normals are right."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import DA_POSE, Body, Landmarks, vertex_normals
from stages.avatar.model.person import bone_transforms
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES

F64 = torch.float64


def pose(frames=4, seed=0, spread=0.6):
    g = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, dtype=F64, generator=g)  # noqa: E731
    return draw(10), spread * draw(frames, 3), spread * draw(frames, 69), draw(frames, 3)


def by_the_book(model, betas, orient, body_pose, transl):
    """SMPL eq. 2-4 and 9 for one frame, joint by joint and vertex by vertex, in numpy and scipy."""
    shaped = model.v_template + model.shapedirs @ betas
    joints = model.J_regressor @ shaped
    turns = Rotation.from_rotvec(np.concatenate([orient, body_pose]).reshape(24, 3)).as_matrix()
    shaped = shaped + model.posedirs @ (turns[1:] - np.eye(3)).ravel()
    world = []
    for k in range(24):
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turns[k], joints[k] - (joints[model.parents[k]] if k else 0)
        world.append(world[model.parents[k]] @ local if k else local)
    posed = np.zeros_like(shaped)
    for v in range(len(shaped)):
        for k in range(24):
            at_rest = np.append(shaped[v] - joints[k], 1)
            posed[v] += model.lbs_weights[v, k] * (world[k] @ at_rest)[:3]
    return posed + transl, np.stack([g[:3, 3] for g in world]) + transl


def test_agrees_with_smpl_by_the_book(small_body):
    model = small_body()
    args = pose()
    vertices, joints = Body(model, F64)(*args)
    for f in range(4):
        truth = by_the_book(model, args[0].numpy(), *(x[f].numpy() for x in args[1:]))
        assert np.allclose(vertices[f], truth[0], atol=1e-12) and np.allclose(joints[f], truth[1], atol=1e-12)


def test_c02_float32_is_float64_to_rounding(small_body, held):
    model, args = small_body(), pose()
    exact = Body(model, F64)(*args)
    single = Body(model)(*(x.float() for x in args))
    assert single[0].dtype == torch.float32
    held(max((a - b).abs().max() for a, b in zip(exact, single, strict=True)), 3e-6)


def test_e14_zero_pose_and_shape_is_the_template(small_body):
    body = Body(small_body(), F64)
    vertices, joints = body(torch.zeros(10).double(), *(torch.zeros(2, n).double() for n in (3, 69, 3)))
    assert torch.allclose(vertices, body.v_template.expand_as(vertices), atol=1e-12)
    assert torch.allclose(joints[0], body.joint_template, atol=1e-12)


def test_e14_root_turns_about_the_pelvis_and_commutes_with_skinning(small_body):
    body = Body(small_body(), F64)
    betas, orient, body_pose, transl = pose()
    vertices, joints = body(betas, orient, body_pose, transl * 0)
    pelvis = body.rest(betas)[1][0]
    assert torch.allclose(joints[:, 0], pelvis.expand(4, 3), atol=1e-12)
    turn = matrix_from_rotvec(orient)
    still = body(betas, orient * 0, body_pose, transl * 0)[0]
    assert torch.allclose((still - pelvis) @ turn.mT + pelvis, vertices, atol=1e-12)


def test_c01_d04_gradients(small_body):
    body = Body(small_body(vertices=26), F64)
    args = [x.requires_grad_() for x in pose(frames=2)]
    assert torch.autograd.gradcheck(lambda *a: body(*a), args, eps=1e-6, atol=1e-7, fast_mode=True)
    rest = [x.detach() * 0 for x in args]
    rest = [x.requires_grad_() for x in rest]
    body(*rest)[0].square().sum().backward()
    assert all(x.grad.isfinite().all() and x.grad.abs().max() > 0 for x in rest)


def test_betas_may_differ_by_frame(small_body):
    body = Body(small_body(), F64)
    betas, orient, body_pose, transl = pose()
    each = body(torch.stack([betas, betas * 2, -betas, betas * 0]), orient, body_pose, transl)[0]
    assert torch.allclose(each[1], body(betas * 2, orient, body_pose, transl)[0][1], atol=1e-12)


def test_subset_is_the_same_body(small_body):
    body = Body(small_body(), F64)
    args, some = pose(), torch.tensor([7, 3, 50])
    whole, part = body(*args), body.subset(some)(*args)
    assert torch.allclose(part[0], whole[0][:, some], atol=1e-12) and torch.equal(part[1], whole[1])


@pytest.mark.parametrize("posedirs", [True, False])
def test_landmarks_equal_the_regressed_vertices(small_body, posedirs):
    body = Body(small_body(posedirs=posedirs), F64)
    assert bool(body.posedirs.shape[-1]) == posedirs
    regressor = torch.rand(5, 60, dtype=F64, generator=torch.Generator().manual_seed(0)) ** 4
    regressor /= regressor.sum(1, keepdim=True)
    regressor[4] *= 0.9
    args = pose()
    vertices, joints = body(*args)
    points, same_joints = Landmarks(body, regressor)(*args)
    assert torch.allclose(points, regressor @ vertices, atol=1e-12)
    assert torch.allclose(same_joints, joints, atol=1e-12)
    betas = torch.stack([args[0]] * 4)
    assert torch.allclose(Landmarks(body, regressor)(betas, *args[1:])[0], points, atol=1e-12)


def test_da_pose_spreads_the_legs(small_body):
    assert DA_POSE.shape == (69,) and DA_POSE.nonzero().flatten().tolist() == [2, 5]
    body = Body(small_body(), F64)
    joints = body.rest(torch.zeros(10, dtype=F64))[1]
    left = bone_transforms(joints, body.parents, torch.zeros(3).double(), DA_POSE.double())[1, :3, :3]
    assert torch.allclose(left, matrix_from_rotvec(torch.tensor([0, 0, 1.0], dtype=F64)), atol=1e-12)


def test_normals_point_out_and_lonely_vertices_have_none():
    points = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [5, 5, 5]])
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    normals = vertex_normals(points, faces)
    assert torch.allclose(normals[:4], points[:4] / 3**0.5, atol=1e-6)
    assert torch.equal(normals[4], torch.zeros(3))


@pytest.mark.parametrize(
    "joint, turn, least",
    [
        ("left_shoulder", (0, 0, -1.2), 0.99),  # the arm hangs
        ("left_shoulder", (0, 0, 1.2), 0.995),  # it is raised
        ("right_shoulder", (0, 1.5, 0), 0.99),  # it points forward
        ("left_hip", (-1.5, 0, 0), 0.97),  # sits
        ("right_hip", (0, 0, -0.8), 0.995),  # the leg goes aside
    ],
)
def test_the_free_body_keeps_its_volume_at_shoulders_and_hips(joint, turn, least):
    """It has no pose correctives: these are what its skinning weights alone do. Its volume at rest is 63 litres."""
    model = read_body_model()
    body_pose = torch.zeros(2, 23, 3, dtype=F64)
    body_pose[1, JOINT_NAMES.index(joint) - 1] = torch.tensor(turn, dtype=F64)
    zero = torch.zeros(2, 3, dtype=F64)
    vertices, _ = Body(model, F64)(torch.zeros(10, dtype=F64), zero, body_pose.flatten(1), zero)
    a, b, c = (vertices[:, model.faces[:, i].astype(np.int64)] for i in range(3))
    rest, posed = ((a * torch.linalg.cross(b, c)).sum((-1, -2)) / 6).tolist()
    print(f"{joint}: {posed / rest:.4f} of {1000 * rest:.1f} litres")
    assert 0.055 < rest < 0.075
    assert least < posed / rest < 1.015

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.avatar import rotations as r

AXES = [torch.tensor(a, dtype=torch.float64) for a in itertools.product((-1.0, 0, 1), repeat=3) if any(a)]
SINGULAR = [(0.0,) * 3, (-1e-8,) * 3, (1e-7, 0, 0), (1e-4, 0, 0), (0.0099, 0, 0), (0.0101, 0, 0), (math.pi, 0, 0)]
SINGULAR += [(0, 2 * math.pi, 0), (0, 2 * math.pi - 1e-6, 0), (100 * math.pi, 0, 0)]
SINGULAR_6D = [(0,) * 6, (1e-25,) * 6, (1e-13, 0, 0, 0, 1e-13, 0), (1e18, 0, 0, 0, 1e18, 0), (1e20, 1, 0, 0, 1e20, 0)]
SINGULAR_6D += [(1, 0, 0, 2, 0, 0), (0.3, 0.5, 0.7, 0.6, 1, 1.4), (1, 0, 0, 0, 0, 0), (0, 0, 0, 0, 1, 0)]
SINGULAR_6D += [(1, 0, 0, 1, 1e-4, 0), (1, 0, 0, 1, 1e-7, 0)]


def assert_rotation(matrix, atol):
    eye = torch.eye(3, dtype=matrix.dtype)
    assert torch.allclose(matrix @ matrix.mT, eye.expand_as(matrix), rtol=0, atol=atol)
    assert torch.allclose(torch.linalg.det(matrix), torch.ones(matrix.shape[:-2], dtype=matrix.dtype), atol=atol)


@pytest.mark.parametrize("vector", SINGULAR)
def test_rotvec_is_a_rotation_with_true_gradient_at_every_singular_point(vector):
    single = torch.tensor(vector, dtype=torch.float32, requires_grad=True)
    double = single.detach().double().requires_grad_()
    weights = torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double()
    matrix = r.matrix_from_rotvec(single)
    assert_rotation(matrix, 1e-6)
    truth = torch.linalg.matrix_exp(r.cross_matrix(double))
    assert torch.allclose(matrix.double(), truth, atol=2e-6)
    (matrix * weights.float()).sum().backward()
    (truth * weights).sum().backward()
    assert torch.allclose(single.grad.double(), double.grad, atol=5e-6)


def test_rotvec_gradient_at_zero_is_the_generators():
    jacobian = torch.autograd.functional.jacobian(r.matrix_from_rotvec, torch.zeros(3))
    for axis in range(3):
        assert torch.equal(jacobian[..., axis], r.cross_matrix(torch.eye(3)[axis]))


def test_second_order_terms_survive_small_angles():
    theta = 1e-4
    matrix = r.matrix_from_rotvec(torch.tensor([theta, 0, 0]))
    off = r.matrix_from_rotvec(torch.tensor([0.02, 0, 0]))
    assert 1 - off[1, 1].item() == pytest.approx(2 * math.sin(0.01) ** 2, rel=1e-3)
    assert matrix[2, 1].item() == pytest.approx(theta, rel=1e-6)


@pytest.mark.parametrize("dtype,atol", [(torch.float64, 1e-7), (torch.float32, 2e-3)])
@pytest.mark.parametrize("short_of_pi", [0.0, 1e-6, -1e-4, 1e-4])
def test_log_at_pi_about_all_26_axes(dtype, atol, short_of_pi):
    axes = torch.stack([a / a.norm() for a in AXES])
    rotvec = ((math.pi - short_of_pi) * axes).to(dtype)
    matrix = r.matrix_from_rotvec(rotvec).requires_grad_()
    back = r.rotvec_from_matrix(matrix)
    assert (back.norm(dim=-1) <= math.pi + 1e-5).all()
    assert torch.allclose(r.matrix_from_rotvec(back), matrix, atol=1e-6 if dtype == torch.float64 else 1e-5)
    back.sum().backward()
    assert matrix.grad.isfinite().all() and matrix.grad.abs().max() < 10


def test_log_and_quaternion_move_at_the_identity():
    eye = torch.eye(3, dtype=torch.float64, requires_grad=True)
    for function in (r.rotvec_from_matrix, r.quat_from_matrix):
        (grad,) = torch.autograd.grad(function(eye).sum(), eye)
        assert grad.isfinite().all() and grad.abs().max() > 0.1
    rotvec = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(lambda v: r.rotvec_from_matrix(r.matrix_from_rotvec(v)), rotvec)
    assert torch.allclose(jacobian, torch.eye(3, dtype=torch.float64), atol=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.floats(1e-9, math.pi - 1e-3))
@settings(max_examples=200, deadline=None)
def test_round_trips_close(axis, angle):
    axis = torch.tensor(axis, dtype=torch.float64)
    if axis.norm() < 1e-3:
        return
    rotvec = axis / axis.norm() * angle
    matrix = r.matrix_from_rotvec(rotvec)
    assert torch.allclose(r.rotvec_from_matrix(matrix), rotvec, rtol=1e-9, atol=1e-12)
    assert torch.allclose(r.matrix_from_quat(r.quat_from_matrix(matrix)), matrix, atol=1e-12)
    assert torch.allclose(r.matrix_from_6d(matrix.mT.flatten()[:6]), matrix, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-25, 1e-7, 1.0, 1e20])
def test_quaternion_length_and_sign_cancel(scale):
    quat = torch.tensor([0.3, -0.5, 0.7, 0.2])
    truth = r.matrix_from_quat(quat.double())
    assert_rotation(truth, 1e-14)
    for signed in (quat * scale, -quat * scale):
        assert torch.allclose(r.matrix_from_quat(signed).double(), truth, atol=1e-6)


def test_zero_quaternion_is_the_identity_and_spoils_no_neighbour():
    quat = torch.tensor([[0.0, 0, 0, 0], [1, 2, 3, 4]], requires_grad=True)
    matrix = r.matrix_from_quat(quat)
    assert torch.equal(matrix[0], torch.eye(3))
    (matrix * torch.arange(9.0).view(3, 3)).sum().backward()
    assert torch.equal(quat.grad[0], torch.zeros(4)) and quat.grad[1].abs().max() > 0


@pytest.mark.parametrize("six", SINGULAR_6D)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_6d_degenerate_rows_are_rotations_with_bounded_gradient(six, dtype):
    row = torch.tensor(six, dtype=dtype, requires_grad=True)
    matrix = r.matrix_from_6d(row)
    assert_rotation(matrix.double(), 1e-6)
    (matrix * torch.arange(9.0, dtype=dtype).view(3, 3) / 4).sum().backward()
    assert row.grad.isfinite().all() and row.grad.abs().max() <= 1e4


def test_6d_names_the_degenerate_rows_only():
    rows = torch.tensor(
        [[1.0, 0, 0, 0, 1, 0], [1e18, 0, 0, 0, 1e18, 0], [0] * 6, [1, 0, 0, 2, 0, 0], [2, 0, 0, 1, 0.1, 0]]
    )
    assert r.is_degenerate_6d(rows).tolist() == [False, False, True, True, False]


def test_6d_takes_columns():
    quarter = r.matrix_from_rotvec(torch.tensor([0, 0, math.pi / 2]))
    assert torch.allclose(r.matrix_from_6d(torch.tensor([0.0, 2, 0, -3, 0, 0])), quarter, atol=1e-6)


@pytest.mark.parametrize("name", ["matrix_from_rotvec", "matrix_from_quat", "matrix_from_6d", "rotation_z_to"])
def test_gradcheck(name):
    size = {"matrix_from_quat": 4, "matrix_from_6d": 6}.get(name, 3)
    x = torch.randn(5, size, dtype=torch.float64, generator=torch.Generator().manual_seed(3), requires_grad=True)
    assert torch.autograd.gradcheck(getattr(r, name), x, eps=1e-6, atol=1e-7)


def test_gradcheck_of_rotvec_on_both_sides_of_the_series():
    x = torch.tensor([[0.0, 0, 0], [0.005, 0, 0], [0, 0.00999, 0], [0, 0, 0.0101], [3.1, 0.3, 0]], dtype=torch.float64)
    assert torch.autograd.gradcheck(r.matrix_from_rotvec, x.requires_grad_(), eps=1e-6, atol=1e-7)
    m = r.matrix_from_rotvec(x.detach()).requires_grad_()
    assert torch.autograd.gradcheck(r.quat_from_matrix, m, eps=1e-6, atol=1e-7)
    assert torch.autograd.gradcheck(r.rotvec_from_matrix, m, eps=1e-6, atol=1e-6)


def test_z_reaches_every_normal():
    g = torch.Generator().manual_seed(1)
    special = [
        [0, 0, 1],
        [0, 0, -1],
        [1e-8, 0, 1],
        [1e-2, 1e-3, -1],
        [1, 0, 0],
        [0, -1, 0],
        [1, 0, -1e-9],
        [3e-30, 0, 0],
    ]
    normals = torch.cat([torch.tensor(special), torch.randn(10000, 3, generator=g) * 50]).requires_grad_()
    matrix = r.rotation_z_to(normals)
    assert_rotation(matrix, 1e-6)
    unit = torch.nn.functional.normalize(normals.detach().double(), dim=-1, eps=1e-300)
    assert torch.allclose(matrix[..., 2].double(), unit, atol=1e-6)
    (matrix * torch.arange(9.0).view(3, 3)).sum().backward()
    assert normals.grad[:7].isfinite().all() and normals.grad[8:].isfinite().all()


def test_zero_normal_is_the_identity():
    assert torch.equal(r.rotation_z_to(torch.zeros(2, 3)), torch.eye(3).expand(2, 3, 3))


def test_angle_between_keeps_its_digits():
    for angle in (0.0, 1e-6, 1e-3, 1.0, 3.0, math.pi):
        turned = r.matrix_from_rotvec(torch.tensor([0.0, angle, 0]))
        assert r.angle_between(torch.eye(3), turned).item() == pytest.approx(angle, abs=1e-6 if angle < 2 else 1e-3)


def test_nan_stays_visible():
    for function, size in (
        (r.matrix_from_rotvec, 3),
        (r.matrix_from_quat, 4),
        (r.matrix_from_6d, 6),
        (r.rotation_z_to, 3),
    ):
        assert function(torch.full((size,), math.nan)).isnan().any()

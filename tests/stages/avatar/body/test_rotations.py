"""Rotations: values and gradients at every singular point, round trips, and what is degenerate."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.avatar.body import rotations as r

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
def test_d04_rotvec_is_a_rotation_with_true_gradient_at_every_singular_point(vector, held):
    single = torch.tensor(vector, dtype=torch.float32, requires_grad=True)
    double = single.detach().double().requires_grad_()
    weights = torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).double()
    matrix = r.matrix_from_rotvec(single)
    assert_rotation(matrix, 1e-6)
    truth = torch.linalg.matrix_exp(r.cross_matrix(double))
    held((matrix - truth).abs().max(), 4e-6 if double.norm() > 7 else 1e-6)
    (matrix * weights.float()).sum().backward()
    (truth * weights).sum().backward()
    held((single.grad - double.grad).abs().max(), 5e-6)


def steps(function, path):
    """The largest step of a function [.., 3,3] between neighbours on a path [N,..], in units of the path's own step."""
    values, moved = function(path), (path[1:] - path[:-1]).flatten(1).norm(dim=1)
    return ((values[1:] - values[:-1]).flatten(1).norm(dim=1) / moved).max().item()


@pytest.mark.parametrize("middle", [0.0, 0.01, math.pi, 2 * math.pi, -0.01])
def test_d04_a_path_through_a_singular_point_is_smooth(middle, held):
    """Along an axis through 0, both sides of the series, half and whole turns: value and slope move with the angle."""
    angles = (middle + torch.linspace(-1e-3, 1e-3, 21, dtype=torch.float64))[:, None]
    path = angles * torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
    held(steps(r.matrix_from_rotvec, path), 3 * 2**0.5, "value")
    slopes = [torch.autograd.functional.jacobian(r.matrix_from_rotvec, v) for v in path]
    held(steps(lambda _: torch.stack(slopes), path), 10, "slope")


def test_d04_rotvec_gradient_at_zero_is_the_generators():
    jacobian = torch.autograd.functional.jacobian(r.matrix_from_rotvec, torch.zeros(3))
    for axis in range(3):
        assert torch.equal(jacobian[..., axis], r.cross_matrix(torch.eye(3)[axis]))


@pytest.mark.parametrize("theta", [1e-8, 1e-6, 1e-4, 9.9e-3, 1.01e-2, 0.1, 1.0, 3.0, math.pi])
def test_d05_second_order_terms_survive_small_angles(theta, held):
    """1 - cos theta is 0 in float32 under 2e-4; the entry that is its half product of axis components shows it whole."""
    x, y = 0.6, 0.8
    matrix = r.matrix_from_rotvec(torch.tensor([theta * x, theta * y, 0]))
    truth = 2 * math.sin(theta / 2) ** 2 * x * y
    held(abs(matrix[0, 1].item() / truth - 1), 1e-6)
    held(abs(matrix[2, 1].item() - math.sin(theta) * x), 1e-6 * theta)


@pytest.mark.parametrize("dtype,atol", [(torch.float64, 2e-15), (torch.float32, 2e-6)])
@pytest.mark.parametrize("short_of_pi", [0.0, 1e-6, -1e-4, 1e-4])
def test_d06_log_at_pi_about_all_26_axes(dtype, atol, short_of_pi, held):
    axes = torch.stack([a / a.norm() for a in AXES])
    rotvec = ((math.pi - short_of_pi) * axes).to(dtype)
    matrix = r.matrix_from_rotvec(rotvec).requires_grad_()
    back = r.rotvec_from_matrix(matrix)
    assert (back.norm(dim=-1) <= math.pi + 1e-5).all()
    held((r.matrix_from_rotvec(back) - matrix).abs().max(), atol)
    back.sum().backward()
    assert matrix.grad.isfinite().all() and matrix.grad.flatten(1).norm(dim=1).min() > 0.1
    held(matrix.grad.abs().max(), 10, "gradient")


def test_d11_log_and_quaternion_move_at_the_identity():
    eye = torch.eye(3, dtype=torch.float64, requires_grad=True)
    for function in (r.rotvec_from_matrix, r.quat_from_matrix):
        (grad,) = torch.autograd.grad(function(eye).sum(), eye)
        assert grad.isfinite().all() and grad.abs().max() > 0.1
    rotvec = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(lambda v: r.rotvec_from_matrix(r.matrix_from_rotvec(v)), rotvec)
    assert torch.allclose(jacobian, torch.eye(3, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("turn", range(26))
def test_d11_quaternions_are_exact_where_the_trace_is_minus_one(turn, held):
    axis = AXES[turn] / AXES[turn].norm()
    for angle in (math.pi, math.pi - 1e-7, math.pi - 1e-3):
        matrix = r.matrix_from_rotvec(angle * axis).float().requires_grad_()
        quat = r.quat_from_matrix(matrix)
        truth = torch.cat([torch.tensor([math.cos(angle / 2)]).double(), math.sin(angle / 2) * axis])
        held(1 - (quat.double() @ truth).abs(), 2e-7)
        quat.sum().backward()
        assert matrix.grad.isfinite().all() and matrix.grad.abs().max() < 10


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.floats(1e-9, math.pi - 1e-3))
@settings(max_examples=100, deadline=None)
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
def test_d08_quaternion_length_and_sign_cancel(scale):
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
def test_d01_d02_d03_degenerate_6d_rows_are_rotations_with_bounded_gradient(six, dtype, held):
    row = torch.tensor(six, dtype=dtype, requires_grad=True)
    matrix = r.matrix_from_6d(row)
    assert_rotation(matrix.double(), 1e-6)
    weights = torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).to(dtype)
    (matrix * weights / weights.norm()).sum().backward()
    assert row.grad.isfinite().all()
    held(row.grad.norm(), 10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_d01_d02_d03_paths_into_degenerate_rows_stay_rotations(dtype, held):
    """A half that shrinks to nothing, and halves that close to parallel: the gradient grows, but never past its bound."""
    for down in (10.0 ** -torch.arange(0, 26, 0.5)).tolist():
        for six in (
            [down, down / 2, 0, 0, 1, 0],
            [1, 0.5, 0, 0, down, 0],
            [1, 0, 0, 1, down, 0],
            [0.3, 0.5, 0.7, 0.6, 1, 1.4 + down],
        ):
            row = torch.tensor(six, dtype=dtype, requires_grad=True)
            matrix = r.matrix_from_6d(row)
            assert_rotation(matrix.double(), 2e-6)
            weights = torch.randn(3, 3, generator=torch.Generator().manual_seed(0)).to(dtype)
            (matrix * weights / weights.norm()).sum().backward()
            held(row.grad.norm() if row.grad.isfinite().all() else math.inf, 2000)
    wide = torch.tensor([[1.0, 0, 0, 1, 2e-3, 0], [2, 1, 0, 1, 0.4, 3]], dtype=dtype)  # narrow, but rotations
    e1 = wide[:, :3] / wide[:, :3].norm(dim=1, keepdim=True)
    assert torch.allclose(r.matrix_from_6d(wide)[..., 0], e1), "whose first axis is theirs"


@pytest.mark.parametrize("size", [1.0, 0.11, 4e8])
def test_plain_6d_is_the_same_as_any(size, held):
    six = torch.randn(400, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * size
    upstream = torch.randn(len(six), 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    alone = [r._plain_matrix_from_6d(row) is not None for row in six]
    assert 0.2 < sum(alone) / len(alone) < 1, "some rows are too short, long or narrow for it"
    assert r._plain_matrix_from_6d(six) is None, "and one such row is enough"
    six, upstream = six[alone], upstream[alone]
    leaf = six.clone().requires_grad_()
    plain, exact = r._plain_matrix_from_6d(leaf), r._any_matrix_from_6d(leaf)
    slopes = [torch.autograd.grad(matrix, leaf, upstream)[0] for matrix in (plain, exact)]
    held((plain - exact).abs().max(), 1e-14)
    held((slopes[0] - slopes[1]).norm() / slopes[1].norm(), 4e-15)
    held((r._plain_matrix_from_6d(six.float()) - exact).abs().max(), 1e-5)


def test_6d_takes_columns():
    quarter = r.matrix_from_rotvec(torch.tensor([0, 0, math.pi / 2]))
    assert torch.allclose(r.matrix_from_6d(torch.tensor([0.0, 2, 0, -3, 0, 0])), quarter, atol=1e-6)


@pytest.mark.parametrize("name", ["matrix_from_rotvec", "matrix_from_quat", "matrix_from_6d", "rotation_z_to"])
def test_c01_gradcheck(name):
    size = {"matrix_from_quat": 4, "matrix_from_6d": 6}.get(name, 3)
    x = torch.randn(5, size, dtype=torch.float64, generator=torch.Generator().manual_seed(3), requires_grad=True)
    assert torch.autograd.gradcheck(getattr(r, name), x, eps=1e-6, atol=1e-7)


def test_c01_d04_gradcheck_of_rotvec_on_both_sides_of_the_series():
    x = torch.tensor([[0.0, 0, 0], [0.005, 0, 0], [0, 0.00999, 0], [0, 0, 0.0101], [3.1, 0.3, 0]], dtype=torch.float64)
    assert torch.autograd.gradcheck(r.matrix_from_rotvec, x.requires_grad_(), eps=1e-6, atol=1e-7)
    m = r.matrix_from_rotvec(x.detach()).requires_grad_()
    assert torch.autograd.gradcheck(r.quat_from_matrix, m, eps=1e-6, atol=1e-7)
    assert torch.autograd.gradcheck(r.rotvec_from_matrix, m, eps=1e-6, atol=1e-6)


def test_d12_z_reaches_every_normal(held):
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
    held((matrix[..., 2] - unit).abs().max(), 1e-6)
    held((matrix.double() @ matrix.double().mT - torch.eye(3)).abs().max(), 2e-6)
    (matrix * torch.arange(9.0).view(3, 3)).sum().backward()
    assert normals.grad[:7].isfinite().all() and normals.grad[8:].isfinite().all()


def test_d12_zero_normal_is_the_identity():
    assert torch.equal(r.rotation_z_to(torch.zeros(2, 3)), torch.eye(3).expand(2, 3, 3))


def test_d12_no_normal_turns_a_round_flat_gaussian_suddenly(held):
    """Over both poles and across the equator, where the two halves meet with a half turn about the normal itself."""
    t = torch.linspace(0, 2 * math.pi, 20_001, dtype=torch.float64)
    for path in (torch.stack([t.sin(), 0 * t, t.cos()], 1), torch.stack([0.6 * t.sin(), 0.8 * t.sin(), t.cos()], 1)):
        flat = r.rotation_z_to(path) @ torch.diag(torch.tensor([1.0, 1, 0.5], dtype=torch.float64))
        held(steps(lambda _, covariances=flat @ flat.mT: covariances, path), 2)
        assert (r.rotation_z_to(path)[1:] - r.rotation_z_to(path)[:-1]).abs().max() > 1, "the path crosses the seam"


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 1.0, 3.0, math.pi])
def test_d10_angle_between_keeps_its_digits(angle, held):
    """acos of the trace of equal float32 rotations is not-a-number for half of them, and off by 1e-3 for the others."""
    turned = r.matrix_from_rotvec(torch.tensor([0.0, angle, 0]))
    held(abs(r.angle_between(torch.eye(3), turned).item() - angle), 1e-6 if angle < 2 else 3e-5)
    rotations = r.matrix_from_quat(torch.randn(1000, 4, generator=torch.Generator().manual_seed(0)))
    held(r.angle_between(rotations, rotations.clone()).max(), 1e-6)


def test_nan_stays_visible():
    for function, size in (
        (r.matrix_from_rotvec, 3),
        (r.matrix_from_quat, 4),
        (r.matrix_from_6d, 6),
        (r.rotation_z_to, 3),
    ):
        assert function(torch.full((size,), math.nan)).isnan().any()

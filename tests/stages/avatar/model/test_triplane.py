"""The triplane equals grid_sample in value and gradient, and names points that are not finite."""

import subprocess
import sys

import pytest
import torch
import torch.nn.functional as F

from stages.avatar.model.triplane import Triplane, _Features, features_reference


def field(resolution: int = 9, channels: int = 4) -> Triplane:
    generator = torch.Generator().manual_seed(3)
    return Triplane(torch.tensor([-1.0, 0, -0.2]), torch.tensor([1.0, 2, 0.3]), channels, resolution, generator)


def points(n: int = 200) -> torch.Tensor:
    t = field()
    return t.lower + (t.upper - t.lower) * torch.rand(n, 3, generator=torch.Generator().manual_seed(1))


def test_f04_equals_grid_sample_in_value_and_gradient():
    t, p = field().double(), points().double()
    x = p.clone().requires_grad_()
    ours = t(x)
    planes = t.table.detach().reshape(3, 9, 9, 4).permute(0, 3, 1, 2).clone().requires_grad_()
    y = p.clone().requires_grad_()
    u = (y - t.lower) / (t.upper - t.lower) * 2 - 1
    grid = torch.stack([u[:, [0, 1]], u[:, [0, 2]], u[:, [1, 2]]])[:, :, None]
    theirs = F.grid_sample(planes, grid, align_corners=True)[..., 0].permute(2, 0, 1).reshape(len(p), -1)
    assert torch.allclose(ours, theirs, atol=1e-10)
    weight = torch.randn_like(ours)
    (ours * weight).sum().backward()
    (theirs * weight).sum().backward()
    assert torch.allclose(x.grad, y.grad, atol=1e-9)
    assert torch.allclose(t.table.grad.reshape(3, 9, 9, 4), planes.grad.permute(0, 2, 3, 1), atol=1e-9)


@pytest.mark.parametrize("channels", [1, 4, 32, 40])
def test_the_fused_kernel_agrees_with_its_specification(channels):
    u = 8 * torch.rand(300, 3, generator=torch.Generator().manual_seed(1))
    u[:3] = torch.tensor([[0.0], [8.0], [4.0]])  # both ends and a node, where the slope has two values
    table = torch.randn(3 * 81, channels, generator=torch.Generator().manual_seed(2))
    weight = torch.randn(len(u), 3 * channels, generator=torch.Generator().manual_seed(4))
    results = []
    for read, dtype in ((_Features.apply, torch.float32), (features_reference, torch.float64)):
        leaves = [t.to(dtype, copy=True).requires_grad_() for t in (u, table)]
        out = read(*leaves, 9)
        (out * weight).sum().backward()
        results.append((out, *(leaf.grad for leaf in leaves)))
    for name, a, b in zip(("features", "points", "table"), *results):
        assert (a - b).norm() < 1e-6 * b.norm(), f"{name} off by {(a - b).norm() / b.norm():.1e}"


def test_f04_reproduces_a_linear_field_and_notices_swapped_axes(held):
    t = field(channels=1)
    i = torch.arange(9.0)
    with torch.no_grad():
        t.table.copy_((2 * i[None, :] + 5 * i[:, None]).reshape(-1, 1).repeat(3, 1))
    p = points()
    u = (p - t.lower) / (t.upper - t.lower) * 8
    want = torch.stack([2 * u[:, a] + 5 * u[:, b] for a, b in ((0, 1), (0, 2), (1, 2))], 1)
    held((t(p) - want).abs().max() / want.abs().max(), 1e-6)
    assert not torch.allclose(t(p[:, [1, 0, 2]]), want, atol=1e-1)


def test_f01_outside_reads_the_face_and_can_return():
    t = field()
    far = torch.tensor([[40.0, 1.0, 0.0]], requires_grad=True)
    face = torch.tensor([[1.0, 1.0, 0.0]])
    assert torch.allclose(t(far), t(face))
    t.outside(far).backward()
    assert far.grad[0, 0] > 0 and (far.grad[0, 1:] == 0).all()
    again = far.detach().requires_grad_()
    t(again).square().sum().backward()
    assert again.grad.isfinite().all() and again.grad.abs().sum() > 0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_f02_a_point_that_is_not_finite_is_named(bad):
    p = points(8)
    p[5, 1] = bad
    with pytest.raises(ValueError, match="point 5"):
        field()(p)


def test_f05_crowding_in_one_cell_is_summed_right(held):
    t, single = field(), field().double()
    p = t.lower + 1e-3 + torch.zeros(110_000, 3)
    t(p).sum().backward()
    single(p[:1].double()).sum().backward()
    assert single.table.grad.abs().sum() > 0
    held((t.table.grad / len(p) - single.table.grad).abs().max() / single.table.grad.abs().max(), 5e-3)


CRASHES = """
import torch
from tests.stages.avatar.model.test_triplane import field, points
for bad in (float("nan"), float("inf"), -float("inf"), 3e38, -3e38):
    t, p = field(), points(64)
    p[5, 1] = bad
    p.requires_grad_()
    try:
        t(p).sum().backward()
        assert p.grad.isfinite().all() and t.table.grad.isfinite().all()
        print("drawn")
    except ValueError as error:
        print(str(error)[:17])
"""


@pytest.mark.slow
def test_f02_no_coordinate_crashes_the_process():
    done = subprocess.run([sys.executable, "-c", CRASHES], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["canonical point 5"] * 3 + ["drawn"] * 2


def test_f03_a_cell_that_is_not_finite_is_named_though_its_weight_is_0():
    t = field()
    node = t.lower + (t.upper - t.lower) * torch.tensor([[3.0, 5.0, 2.0]]) / 8
    assert t(node).isfinite().all()
    with torch.no_grad():
        t.table[2 * 81 + 2 * 9 + 6, 1] = torch.nan  # the neighbour along y, in the plane yz
    with pytest.raises(ValueError, match=r"\byz\b.*\b1\b.*\(6, 2\)"):
        t(node)

"""Cloth that bones draw wide grows with it, in value and gradient; what only lies beside it does not."""

import pytest
import torch

from stages.avatar.body import stretch
from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.skinning import without_zeros
from stages.avatar.body.smpl import affine
from stages.avatar.body.stretch import STEEPEST, cloth_of, stretch_of
from stages.avatar.model.person import Resting, pose

F64, BONES = torch.float64, 24
SIDE, APART = 15, 0.02  # points of a sheet along each side, m between them


def sheet(dtype=F64, height: float = 0.0) -> torch.Tensor:
    """Points [N,3] of a level sheet about the origin."""
    along = (torch.arange(SIDE, dtype=dtype) - SIDE // 2) * APART
    x, z = torch.meshgrid(along, along, indexing="ij")
    return torch.stack([x.flatten(), torch.full_like(x.flatten(), height), z.flatten()], 1)


def between(points: torch.Tensor) -> torch.Tensor:
    """Weights [N,26] on two bones of clothes: from one to the other along x, over the sheet."""
    weights = points.new_zeros(len(points), BONES + 2)
    weights[:, BONES] = (0.5 + points[:, 0] / (SIDE * APART)).clamp(0, 1)
    weights[:, BONES + 1] = 1 - weights[:, BONES]
    return weights


def person(points: torch.Tensor, weights: torch.Tensor) -> Resting:
    """Round Gaussians of 1 cm."""
    still = torch.eye(3).to(points).expand(len(points), 3, 3)
    return Resting(points, 0.01 * still, points[:, 0], points[:, None], weights, still, still[:, 2])


def bones(shift=(0.0, 0, 0), turn=(0.0, 0, 0), dtype=F64) -> torch.Tensor:
    """26 bones at rest, of which the last but one is turned and shifted."""
    found = torch.eye(4, dtype=dtype).repeat(BONES + 2, 1, 1)
    moved = affine(matrix_from_rotvec(torch.tensor(turn, dtype=dtype)), torch.tensor(shift, dtype=dtype))
    return torch.cat([found[:BONES], moved[None], found[-1:]])


def middle(points: torch.Tensor) -> torch.Tensor:
    """Which points are not at the edge."""
    return points[:, [0, 2]].abs().amax(1) < (SIDE // 2 - 0.5) * APART


def grown(points: torch.Tensor, weights: torch.Tensor, all_bones: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Axes [N,3,3] of round Gaussians of 1 m without and with growth."""
    who = person(points, weights)
    found = stretch_of(cloth_of(points, weights, BONES), points, who.axes)
    zero = points.new_zeros(3)
    plain, wide = (pose(who, all_bones, zero, without_zeros(weights), one) for one in (None, found))
    assert torch.equal(plain.means, wide.means)
    return 100 * plain.axes, 100 * wide.axes


def test_a_sheet_that_is_drawn_to_twice_its_width_has_gaussians_nearly_twice_as_wide():
    points = sheet()
    _, wide = grown(points, between(points), bones((SIDE * APART, 0, 0)))
    inner = wide[middle(points)]
    assert inner[:, 0, 0].min() > 1.75 and inner[:, 0, 0].max() < 2, "2, but for what is STIFF"
    torch.testing.assert_close(inner[:, 1:, 1:], torch.eye(2, dtype=F64).expand(len(inner), 2, 2), atol=1e-9, rtol=0)


def test_the_growth_is_the_gradient_of_where_the_weights_lead(monkeypatch):
    """Bones that turn: against the derivative of sum_k w_k(x) A_k x, by autograd, where nothing is stiff."""
    monkeypatch.setattr(stretch, "STIFF", 1e-9)
    points, turned = sheet(), bones((0.1, 0.05, 0), (0.0, 0, 0.6))

    def led(x: torch.Tensor) -> torch.Tensor:
        rows = (between(x[None]) @ turned[:, :3].flatten(1)).view(3, 4)
        return rows[:, :3] @ x + rows[:, 3]

    plain, wide = grown(points, between(points), turned)
    assert (wide - plain)[middle(points)].norm(dim=(1, 2)).min() > 0.3
    for row in middle(points).nonzero()[::7, 0]:
        truth = torch.autograd.functional.jacobian(led, points[row])
        torch.testing.assert_close(wide[row][:, [0, 2]], truth[:, [0, 2]], atol=0.05, rtol=0)


def test_cloth_that_moves_as_one_and_cloth_at_rest_stay_as_they_are(held):
    points = sheet(torch.float32)
    weights = between(points)
    rigid = affine(matrix_from_rotvec(torch.tensor([0.3, -1.0, 0.5])), torch.tensor([0.4, 2.0, -0.3]))
    for all_bones in (torch.eye(4).repeat(BONES + 2, 1, 1), rigid.repeat(BONES + 2, 1, 1)):
        plain, wide = grown(points, weights, all_bones)
        held((plain - wide).abs().max(), 1e-4)


def test_one_piece_of_cloth_beside_another_is_not_drawn_to_it():
    low, high = sheet(), sheet(height=0.01)
    points = torch.cat([low, high])
    weights = torch.zeros(len(points), BONES + 2, dtype=F64)
    weights[: len(low), BONES], weights[len(low) :, BONES + 1] = 1, 1
    away = 0.3
    plain, wide = grown(points, weights, bones((0, away, 0)))
    assert 1 < (wide - plain).norm(dim=(1, 2)).max() < STEEPEST * away


def test_skin_does_not_grow_and_gaussians_in_one_place_do_no_harm():
    points = sheet()
    weights = torch.zeros(len(points), BONES + 2, dtype=F64)
    weights[:, 3] = 1
    assert cloth_of(points, weights, BONES) is None
    weights[0] = torch.eye(BONES + 2)[BONES]
    assert cloth_of(points, weights, BONES) is None, "one has no neighbours"
    plain, wide = grown(torch.zeros_like(points), between(points), bones((0.2, 0, 0)))
    assert torch.equal(plain, wide)
    few = sheet()[:3]
    assert grown(few, between(few), bones((0.2, 0, 0)))[1].isfinite().all()


def test_bones_beyond_those_that_weigh_there_draw_too():
    """Two bones side by side, none of whose cloth the other moves."""
    points = sheet()
    weights = torch.zeros(len(points), BONES + 2, dtype=F64)
    weights[:, BONES] = (points[:, 0] > 1e-6).double()
    weights[:, BONES + 1] = 1 - weights[:, BONES]
    plain, wide = grown(points, weights, bones((0.05, 0, 0)))
    beside = (points[:, 0].abs() < 1e-6) & middle(points)
    assert beside.any() and (wide[beside, 0, 0] > 1.3).all() and (plain[beside, 0, 0] == 1).all()


@pytest.mark.parametrize("turn", [(0.0, 0, 0), (0.0, 0, 3.141592653589793), (0.3, 2.0, -0.4)])
def test_gradients_are_right_at_rest_at_a_half_turn_and_between(turn):
    points = sheet()[::7]
    weights = between(points)
    who = person(points, weights)
    found, few = stretch_of(cloth_of(points, weights, BONES), points, who.axes), without_zeros(weights)
    given = bones((0.1, 0, 0), turn)

    def run(all_bones: torch.Tensor) -> torch.Tensor:
        return 100 * pose(who, all_bones, points.new_zeros(3), few, found).axes

    assert torch.autograd.gradcheck(run, given.requires_grad_(), atol=1e-7)


def test_the_kernel_gives_what_the_specification_gives_in_value_and_gradient(held):
    """Float32 beside float64: cloth that is some of the person, drawn wide and turned."""
    points = torch.cat([sheet(), sheet(height=0.5)])
    weights = between(points)
    weights[SIDE**2 :] = torch.eye(BONES + 2)[3]
    who = person(points, weights)
    cloth = stretch_of(cloth_of(points, weights, BONES), points, who.axes)
    assert torch.equal(cloth.rows, torch.arange(SIDE**2))
    weigh = torch.rand(len(points), 3, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    found = []
    for dtype in (F64, torch.float32):
        who, few = Resting(*(part.to(dtype) for part in who)), without_zeros(weights.to(dtype))
        cloth = cloth._replace(axes=cloth.axes.to(dtype), shares=cloth.shares.to(dtype))
        given = bones((0.1, 0, 0.2), (0.3, 2.0, -0.4), dtype).requires_grad_()
        axes = 100 * pose(who, given, torch.zeros(3, dtype=dtype), few, cloth).axes
        found.append((axes, *torch.autograd.grad((axes * weigh.to(dtype)).sum(), given)))
    for true, fast in zip(*found):
        held((true - fast).abs().max() / true.abs().max(), 3e-6)

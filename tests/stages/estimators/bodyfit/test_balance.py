"""The body's mass stays over the feet that stand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from stages.avatar.body.joints import ANKLES, FEET
from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.balance import GRAVITY, balance_cost, mass_shares, smooth_acceleration
from stages.formats.body_model import read_body_model

MODEL = read_body_model()
UP, TIMES = torch.tensor([0.0, 1, 0]), torch.arange(12) / 12


def standing(beside: float = 0.0, ahead: float = 0.0) -> Tensor:
    """Joints [12,24,3] of somebody upright, y up, +x to the left; all but the feet stand off by so many m."""
    joints = Body(MODEL).rest(torch.zeros(10))[1]
    moved = joints + torch.tensor([float(beside), 0.0, float(ahead)])
    moved[list(ANKLES) + list(FEET)] = joints[[*ANKLES, *FEET]]
    return moved.expand(12, 24, 3)


def cost(joints: Tensor, left: float = 1.0, right: float = 1.0, up_spread: float = 0.0) -> float:
    stands = torch.tensor([left, right]).expand(len(joints), 2)
    return float(balance_cost(joints, stands, TIMES[: len(joints)], UP, up_spread, torch.tensor(1.0)))


def test_mass_over_the_feet_costs_little_and_ahead_of_them_more_the_further():
    upright, little, much = (cost(standing(ahead=ahead)) for ahead in (0.0, 0.1, 0.3))
    assert upright < 1 and upright < little < much
    assert cost(standing(ahead=0.3), 0.0, 0.0) == 0, "who does not stand may lean"
    assert cost(standing(ahead=0.1), up_spread=0.3) < little / 5, "who does not know what is up does not know who leans"


def test_mass_may_stand_anywhere_between_two_feet_but_not_beside_one():
    between, left, right = (cost(standing(beside=0.08), *on) for on in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0)))
    assert between == pytest.approx(cost(standing()), abs=0.05) and between < left < right


def test_who_speeds_up_leans_ahead_of_the_feet():
    pushed = torch.stack([0 * TIMES, 0 * TIMES, 0.5 * 2.0 * TIMES**2], 1)[:, None]  # 2 m/s^2
    costs = [cost(standing(ahead=share * 0.9 * 2.0 / GRAVITY) + pushed) for share in (0, 1, 2)]
    assert costs[1] < costs[0] and costs[1] < costs[2]


def test_a_step_from_foot_to_foot_balances_in_the_mean_of_a_stride():
    joints, stands = standing(), torch.eye(2).repeat(6, 1)
    swaying = joints + torch.where(stands[:, :1] > 0, 0.05, -0.05)[..., None] * torch.tensor([1.0, 0, 0])
    swaying[:, list(ANKLES) + list(FEET)] = joints[:, [*ANKLES, *FEET]]
    assert float(balance_cost(swaying, stands, TIMES, UP, 0.0, torch.tensor(1.0))) < 2.5
    assert cost(standing(beside=0.05), 0.0, 1.0) > 3, "but who stays on one foot has to be over it"


@pytest.mark.parametrize("frames", [1, 2, 12])
def test_feet_at_one_place_and_a_single_frame_have_finite_gradients(frames):
    joints = standing()[:frames].clone()
    joints[:, ANKLES[1]], joints[:, FEET[1]] = joints[:, ANKLES[0]], joints[:, FEET[0]]
    joints.requires_grad_()
    stands = torch.ones(frames, 2)
    balance_cost(joints, stands, TIMES[:frames], UP, 0.0, torch.tensor(1.0)).backward()
    assert joints.grad is not None and torch.isfinite(joints.grad).all() and joints.grad.abs().max() > 0


def test_the_center_of_mass_lies_where_people_have_it():
    shares = mass_shares()
    assert float(shares.sum()) == pytest.approx(1) and (shares >= 0).all()
    vertices, joints = Body(MODEL).rest(torch.zeros(10))
    height = (joints[:, 1] * shares).sum() - vertices[:, 1].min()
    assert 0.53 < float(height) / float(np.ptp(MODEL.v_template[:, 1])) < 0.62


def test_acceleration_of_a_parabola_is_exact_and_of_a_few_points_is_none():
    times = torch.tensor([0.0, 0.1, 0.15, 0.3, 0.4, 0.5, 0.6])
    path = torch.stack([2 * times**2, 3 - times, 0 * times], 1)
    torch.testing.assert_close(smooth_acceleration(path, times, 0.7)[:, 0], torch.full((7,), 4.0), atol=1e-3, rtol=0)
    assert (smooth_acceleration(path, times, 0.1) == 0).all()
    assert (smooth_acceleration(path[:1], times[:1], 0.5) == 0).all()

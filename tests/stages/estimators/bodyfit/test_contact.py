"""The body on the floor: what stands does not slide, hover or sink, and who jumps may."""

from __future__ import annotations

import pytest
import torch

from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.contact import GROUND, STILL, floor_cost, loosen, slide_cost, sole_vertices, stance
from stages.estimators.bodyfit.scale import SOLE
from stages.formats.body_model import read_body_model

ONE = torch.tensor(1.0)
TIMES = torch.arange(6) / 10


def on_floor(height: float = SOLE, lowest: float = SOLE, stands: float = 1.0) -> float:
    feet, body = torch.full((6, 2, 4), float(height)), torch.full((6, 9), float(lowest))
    return float(floor_cost(feet, body, torch.full((6, 2), stands), ONE))


def test_a_body_on_the_floor_costs_nothing_and_one_above_or_below_does():
    assert on_floor() == 0
    assert on_floor(lowest=SOLE + GROUND) == pytest.approx(1 / (1 + 1 / 16))
    assert on_floor(lowest=SOLE - GROUND) == pytest.approx(1 / (1 + 1 / 16))
    assert on_floor(height=SOLE + GROUND, stands=0.0) == 0, "a foot that does not stand may be in the air"
    assert on_floor(height=SOLE - GROUND, stands=0.0) > 0.4, "but no foot is in the floor"
    assert on_floor(lowest=5.0) < 16, "who jumps costs no more the higher"


def test_limits_are_wide_first_and_narrow_from_the_middle_on():
    assert loosen(0.0) == 6 and loosen(0.25) == 3.5 and loosen(0.5) == loosen(1.0) == 1
    feet = torch.full((6, 2, 4), SOLE + 2 * GROUND)
    wide, narrow = (float(floor_cost(feet, feet[:, 0], torch.zeros(6, 2), ONE, loose)) for loose in (6.0, 1.0))
    assert wide < narrow / 10


def test_a_foot_stands_where_it_is_slow_and_on_the_floor():
    feet = torch.zeros(6, 2, 4, 3)
    feet[:, 1, :, 0] = 2 * TIMES[:, None]  # the right one goes at 2 m/s
    assert (stance(feet, None, TIMES)[:, 0] > 0.9).all() and (stance(feet, None, TIMES)[:, 1] < 0.1).all()
    high = torch.zeros(6, 2, 4)
    high[:, 0] = 0.3
    assert (stance(0 * feet, high, TIMES)[:, 0] < 0.1).all() and (stance(0 * feet, high, TIMES)[:, 1] > 0.9).all()
    assert not stance(feet[:1], None, TIMES[:1]).any(), "one frame shows no foot standing"


@pytest.mark.parametrize("frame", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("side", [0, 1])
def test_a_foot_stands_on_through_one_frame_that_errs(frame, side):
    feet = torch.zeros(6, 2, 4, 3)
    feet[frame, side, :, 0] = 0.3  # there and back at 3 m/s
    stands = stance(feet, None, TIMES)
    assert (stands[:, 1 - side] > 0.9).all()
    inside = slice(1, 5)
    assert (stands[inside, side] > 0.9).all(), "between its neighbours it has not moved"


def test_a_standing_foot_that_slides_costs_and_a_moving_one_does_not():
    feet = torch.zeros(6, 2, 4, 3)
    feet[3:, 0, :, 0] = 2 * STILL
    stands = torch.tensor([1.0, 0.0]).expand(6, 2)
    assert float(slide_cost(feet, stands, ONE)) == pytest.approx(4 / (1 + 4 / 16) / 6)
    assert float(slide_cost(feet.flip(1), stands, ONE)) == 0


def test_gradients_are_finite_where_all_is_still():
    feet = torch.zeros(6, 2, 4, 3, requires_grad=True)
    high = feet[..., 1] + SOLE
    cost = slide_cost(feet, torch.ones(6, 2), ONE) + floor_cost(high, high.flatten(1), torch.ones(6, 2), ONE)
    cost.backward()
    assert torch.isfinite(feet.grad).all()


def test_soles_are_under_the_feet():
    model = read_body_model()
    soles = sole_vertices(Body(model))
    points = torch.tensor(model.v_template)[soles]
    assert points[..., 1].max() < model.v_template[:, 1].min() + 0.03
    assert (points[0, :, 0] > 0).all() and (points[1, :, 0] < 0).all(), "SMPL's left is +x"

"""Wide clothes are told from poses that err: they are outside of the skin on both sides, on both legs, in all frames."""

import torch

from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.snug import LEAST, WIDE, hidden_joints, snugness
from stages.formats.body_model import read_body_model

LEG = torch.tensor([0.1, -0.6, 0.0])


def around(centre: torch.Tensor, count: int = 60, seed: int = 0) -> torch.Tensor:
    return centre + 0.03 * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))


def test_a_skirt_is_wide_and_the_shins_below_it_are_snug():
    shin = torch.tensor([0.1, -1.0, 0.0])
    at = torch.cat([around(LEG), around(LEG * torch.tensor([-1, 1, 1])), around(shin)])
    gaps = torch.cat([torch.full((120,), 0.05), torch.full((60,), 0.004)])
    both = torch.stack([LEG, LEG * torch.tensor([-1, 1, 1]), shin])
    assert snugness(both, at, gaps).tolist() == [0, 0, 1]
    half = sum(WIDE) / 2
    torch.testing.assert_close(snugness(both[:2], at, 0 * gaps + half), torch.full((2,), 0.5))


def test_legs_that_are_posed_too_far_to_one_side_are_snug():
    at = torch.cat([around(LEG), around(LEG * torch.tensor([-1, 1, 1]))])
    gaps = torch.cat([torch.full((60,), 0.08), torch.full((60,), -0.08)])
    assert snugness(LEG[None], at, gaps).item() == 1


def test_few_points_say_nothing():
    at = around(LEG, LEAST - 1)
    assert snugness(LEG[None], at, torch.full((len(at),), 0.1)).item() == 1


def test_the_joints_inside_are_named():
    body = Body(read_body_model())
    places, knees = body.v_template, body.joint_template[[4, 5]]
    snug = torch.where(torch.cdist(places, knees).amin(1) < 0.15, 0.0, 1.0)
    assert hidden_joints(body, places, snug) == ["left_knee", "right_knee"]
    assert hidden_joints(body, places, torch.ones(len(places))) == []

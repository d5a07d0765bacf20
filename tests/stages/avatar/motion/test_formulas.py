"""Motions by formula: at rest at the start, feet on the floor, arms and legs as people move them."""

import pytest
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.motion.formulas import MOTIONS
from stages.formats.body_model import read_body_model

FPS = 30
HEELS_AND_BALLS = [7, 8, 10, 11]


@pytest.fixture(scope="module")
def body():
    return Body(read_body_model())


@pytest.fixture(params=MOTIONS)
def name(request):
    return request.param


def joints_of(body, name, seconds=3.3, fps=FPS):
    return body(torch.zeros(10), *MOTIONS[name](seconds, fps))[1]


def test_shapes_and_the_start_at_rest(name):
    for seconds, fps in ((4.0, 30), (0.5, 10), (3.3, 24), (0.1, 25)):
        orient, pose, transl = MOTIONS[name](seconds, fps)
        frames = round(seconds * fps)
        assert orient.shape == (frames, 3) and pose.shape == (frames, 69) and transl.shape == (frames, 3)
        assert all(x.isfinite().all() and x.dtype == torch.float32 for x in (orient, pose, transl))
        assert transl[0].abs().max() < 0.01 and orient[0].abs().max() < 1e-6
        assert pose.view(frames, 23, 3).norm(dim=-1).max() < 2.5
    with pytest.raises(ValueError, match="less than two frames"):
        MOTIONS[name](0.01, 30)


def test_nobody_moves_like_a_puppet(body, name):
    """Joint speeds and accelerations of people: a fast wrist does 6 m/s, a hand in an exercise 100 m/s^2."""
    where = joints_of(body, name, fps=60)
    speed = (where[1:] - where[:-1]) * 60
    jerk = (speed[1:] - speed[:-1]) * 60
    assert speed.norm(dim=-1).max() < 6 and jerk.norm(dim=-1).max() < 100
    assert (where[-1] - where[0]).norm(dim=-1).max() < 0.05  # it can loop
    assert (where.amax(0) - where.amin(0)).norm(dim=-1).max() > 0.4, "something moves"


def test_standing_feet_stay(body, name):
    """A foot on the floor (heel and ball within 5 mm of their lowest) must not slide; in the air it may."""
    feet = joints_of(body, name)[:, HEELS_AND_BALLS]
    floor = feet[..., 1].amin(0)
    assert feet[..., 1].amin() - feet[0, :, 1].amin() > -0.02  # nobody sinks
    low = (feet[..., 1] < floor + 0.005) & (feet[..., 1].roll(1, 0) < floor + 0.005)
    low = (low[:, :2] & low[:, 2:]).repeat(1, 2)
    low[0] = False
    step = (feet - feet.roll(1, 0))[..., [0, 2]].norm(dim=-1)
    assert low.sum() > 10 and step[low].max() * FPS < (0.3 if name == "jumping_jacks" else 0.12)


def test_jumping_jacks_leave_the_floor_and_the_others_do_not_and_hands_stay_out_of_the_body(body, name):
    where = joints_of(body, name)
    lowest = where[:, HEELS_AND_BALLS, 1].amin(1)
    rise = float(lowest.max() - lowest.min())
    assert rise > 0.05 if name == "jumping_jacks" else rise < 0.02
    across = where[:, [20, 21], 0] - where[:, [0], 0]
    assert (across[:, 0] > 0.1).all() and (across[:, 1] < -0.1).all()


def test_jumping_jacks_open_arms_and_legs_together(body):
    where = joints_of(body, "jumping_jacks")
    hands, feet = where[:, 22, 1], where[:, 7, 0] - where[:, 8, 0]
    assert hands.max() > where[0, 15, 1] and hands.min() < where[0, 0, 1] + 0.1
    assert torch.corrcoef(torch.stack([hands, feet]))[0, 1] > 0.9


def test_arms_swing_against_the_legs(body):
    where = joints_of(body, "walk_in_place", seconds=6)
    knee, hand = where[:, 4, 2], where[:, 20, 2]
    assert torch.corrcoef(torch.stack([knee, hand]))[0, 1] < -0.5


def test_the_right_hand_waves_above_the_shoulder(body):
    where = joints_of(body, "wave", seconds=4)[45:75]
    assert (where[:, 23, 1] > where[:, 17, 1] + 0.1).all()
    assert where[:, 23, 0].max() - where[:, 23, 0].min() > 0.1

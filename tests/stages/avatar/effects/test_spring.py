"""Springs of clothes: exact at any frame rate, at rest without a push, and they come to rest after one."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.spring import Springs, sways
from tests.made.clothes import some_clothes

STILL = torch.eye(4).repeat(24, 1, 1)


def swayed(places: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The sway of the first bone, whose body stands still and is carried along `places` [F,3]."""
    clothing = Clothing.of(some_clothes())
    bones = STILL.repeat(len(times), 1, 1, 1)
    told = sways(clothing, bones, torch.as_tensor(places).float(), torch.as_tensor(times))
    return torch.stack([sway[0] for sway in told]).numpy()


def test_it_is_the_damped_oscillator_that_it_says():
    """Against an integrator, on a path of straight pieces: at each corner the speed jumps."""
    times = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.8])
    places = np.random.default_rng(0).normal(0, 0.2, (6, 3))
    speeds = np.diff(places, axis=0) / np.diff(times)[:, None]
    free, damping = some_clothes().spring
    state, wanted = np.zeros(6), [np.zeros(3)]
    for i in range(5):
        if i:
            state[3:] -= speeds[i] - speeds[i - 1]
        found = solve_ivp(
            lambda _, y: np.concatenate([y[3:], -(free**2) * y[:3] - 2 * damping * free * y[3:]]),
            (times[i], times[i + 1]), state, rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        state = found.y[:, -1].copy()
        wanted.append(state[:3].copy())
    np.testing.assert_allclose(swayed(places, times), wanted, atol=1e-6)


@pytest.mark.parametrize("fps", [5, 30, 120])
def test_an_even_walk_is_no_push_and_a_stop_swings_and_comes_to_rest(fps):
    times = np.arange(0, 6, 1 / fps)
    places = np.minimum(times, 2.0)[:, None] * [0.5, 0, 0]
    found = swayed(places, times)[:, 0]
    assert np.abs(found[times <= 2.0]).max() < 1e-5
    after = found[times > 2.0 + 1e-6]
    assert after.max() > 0.03, "it goes on where the body stops"
    assert after.min() < -0.01 and np.abs(found[times > 5.5]).max() < 1e-3, "and swings back, and rests"


def test_a_single_pose_and_one_at_the_same_time_do_not_swing():
    springs = Springs(Clothing.of(some_clothes()))
    for place in (0.0, 5.0):
        assert not springs.at(STILL, torch.tensor([place, 0, 0]), 1.0).any()

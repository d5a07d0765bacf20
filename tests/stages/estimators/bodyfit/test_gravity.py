"""Which way is up, from how people hold cameras."""

from __future__ import annotations

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import look_at
from stages.estimators.bodyfit.gravity import camera_up

UP = np.array([0, 1.0, 0])


def arc(degrees: float, height: float = 1.5, aim: float = 0.9, roll: float = 0.0, count: int = 30) -> np.ndarray:
    """viewmats [count,4,4] around the origin, 3 m away, each rolled by up to `roll` rad."""
    tilt = np.random.default_rng(0).uniform(-roll, roll, count)
    views = []
    for angle, lean in zip(np.radians(np.linspace(-degrees / 2, degrees / 2, count)), tilt, strict=True):
        eye = np.array([3 * np.sin(angle), height, 3 * np.cos(angle)])
        across = np.array([np.cos(angle), 0, -np.sin(angle)])
        views.append(look_at(eye, np.array([0, aim, 0]), UP + np.tan(lean) * across))
    return np.stack(views)


def degrees_off(views: np.ndarray) -> tuple[float, float]:
    """Error of the up axis, and what `camera_up` expects of it, degrees."""
    up, spread = camera_up(views)
    assert np.linalg.norm(up) == pytest.approx(1)
    return float(np.degrees(np.arccos(min(1.0, up @ UP)))), float(np.degrees(spread))


def test_a_camera_that_goes_around_finds_up_although_it_looks_down():
    off, expected = degrees_off(arc(60, height=2.6))
    assert off < 4 and expected < 10
    pitch = np.degrees(np.arctan2(2.6 - 0.9, 3))
    assert off < pitch / 5, "the mean of the cameras' own up axes would be off by all of the pitch"


def test_rolls_of_a_hand_average_out():
    assert degrees_off(arc(60, roll=0.1))[0] < 4


@pytest.mark.parametrize("height", [0.4, 0.9, 1.5, 2.6])
def test_a_camera_that_stands_says_that_its_pitch_is_open(height):
    off, expected = degrees_off(arc(0, height=height))
    assert expected == pytest.approx(20, abs=1) and off < 2 * expected


def test_the_axes_of_the_world_do_not_matter():
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    views, turned = arc(40), arc(40)
    turned[:, :3, :3] = turned[:, :3, :3] @ turn.T
    np.testing.assert_allclose(camera_up(turned)[0], turn @ camera_up(views)[0], atol=1e-9)
    assert camera_up(turned)[1] == pytest.approx(camera_up(views)[1])

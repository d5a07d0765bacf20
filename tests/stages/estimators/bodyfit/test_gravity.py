"""Which way is up, from how people hold cameras and how they stand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import look_at
from stages.estimators.bodyfit.gravity import camera_up, trunk_up, up_on_slope

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


def test_trunks_that_lie_say_nothing_of_what_is_up():
    lies, stands = np.array([1.0, 0.05, 0]), np.array([0, 0.98, 0.2])
    np.testing.assert_allclose(trunk_up(np.stack([lies] * 9 + [stands]), UP), stands / np.linalg.norm(stands))
    np.testing.assert_array_equal(trunk_up(np.stack([lies] * 10), UP), UP)


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


def swaying(ahead: float = 0.0, count: int = 30) -> np.ndarray:
    """Directions [count,3] from the feet to the mass of somebody upright who sways, in degrees; `ahead` of it toward the camera."""
    sway = np.random.default_rng(1).normal(0, 2.5, (count, 2)) + [0, ahead]
    return Rotation.from_euler("zx", sway, degrees=True).apply(UP)


def rolled(views: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    turned = views.copy()
    turned[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees)[:, None] * [0, 0, 1]).as_matrix() @ views[:, :3, :3]
    return turned


@pytest.mark.parametrize("axis", [[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1], [0.7, 0, 0.7]])
def test_on_a_slope_up_is_what_cameras_and_bodies_say(axis):
    normal = Rotation.from_rotvec(np.radians(12) * np.array(axis)).apply(UP)
    found = up_on_slope(arc(60, roll=0.03), normal, swaying())
    assert found is not None
    off, expected = np.degrees(np.arccos(found[0] @ UP)), np.degrees(found[1])
    assert off < 4 and 4 < expected < 8


def test_a_rolled_camera_is_no_slope():
    """Also not one whose roll drifts as it goes around, as the horizon would over a slope."""
    for degrees in (np.full(30, 9.0), np.full(30, -10.0), np.linspace(-6, 6, 30), np.linspace(0, 12, 30)):
        assert up_on_slope(rolled(arc(60), degrees), UP, swaying()) is None


@pytest.mark.parametrize("ahead", [15, -15, 75])
def test_who_leans_or_lies_on_a_level_floor_makes_no_slope_of_it(ahead):
    for roll in (0.0, 6.0):
        assert up_on_slope(rolled(arc(60), np.full(30, roll)), UP, swaying(ahead)) is None


def test_a_slope_that_cameras_cannot_tell_from_how_they_are_held_is_none():
    """Straight ahead of a camera that stays before it, a slope only looks like another pitch; a small one is within the noise."""
    for degrees, views in ((12, arc(4)), (4, arc(60))):
        normal = Rotation.from_rotvec([np.radians(degrees), 0, 0]).apply(UP)
        assert up_on_slope(views, normal, swaying()) is None

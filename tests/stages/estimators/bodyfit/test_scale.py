"""Metres per SfM unit: from a floor under the body, from frames that show its length, from feet that stand still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import project
from stages.estimators.bodyfit.scale import (
    LONG,
    SOLE,
    TimedCameras,
    find_floor,
    find_scale,
    floor_scale,
    lengths_across,
    still_scale,
)
from stages.estimators.ground import Plane
from stages.formats.body_model import read_body_model
from tests.made import bodyfit_clips
from tests.made.odd_clips import (
    carried,
    climb,
    lie,
    make,
    on_board,
    on_trampoline,
    sit,
    slope,
    stairs,
    table,
    told,
    walls,
)

MODEL = read_body_model()


def test_j02_j03_j04_the_floor_is_found_beside_a_wall_and_gives_the_scale(held):
    clip = bodyfit_clips.make(MODEL, frames=12)
    up = clip.joints[:, 15].mean(0) - clip.joints[:, 0].mean(0)
    up /= np.linalg.norm(up)
    lowest = (clip.vertices @ up).argsort(1)[:, :16]
    soles = np.take_along_axis(clip.vertices, lowest[..., None], 1).astype(np.float64)
    views, centers = clip.cameras.viewmats, clip.cameras.centers
    pixels, _ = project(soles / clip.scale, views, clip.cameras.Ks)
    floor = find_floor(clip.points, views, clip.cameras.Ks, pixels, np.full(12, 400.0), up[None])
    assert floor is not None and floor.normal @ up > 0.99
    relative = soles - clip.scale * centers[:, None]
    scale, spread = floor_scale(floor, relative, centers)
    assert scale == pytest.approx(clip.scale, rel=0.01) and spread < 0.02
    relative[3] += 0.4 * floor.normal  # one jump does not change it
    held(abs(floor_scale(floor, relative, centers)[0] / scale - 1), 0.01)
    assert floor_scale(floor, relative * 0, centers) is None  # at the camera's height: no ray meets the floor
    assert floor_scale(replace(floor, offset=floor.offset - 100), relative, centers) is None  # camera below the floor


def skin_of(clip) -> np.ndarray:
    """The true body [F,V,3] m from each frame's camera; its 16 lowest points, of both feet, come first."""
    up = clip.joints[:, 15].mean(0) - clip.joints[:, 0].mean(0)
    lowest = (clip.vertices @ up).argsort(1)
    ordered = np.take_along_axis(clip.vertices, lowest[..., None], 1).astype(np.float64)
    return ordered - clip.scale * clip.cameras.centers[:, None]


def scale_of(clip, skin, size=(480, 864)):
    path = TimedCameras(clip.cameras.viewmats, clip.cameras.Ks, clip.cameras.centers, clip.times, size)
    up = clip.joints[:, 15].mean(0) - clip.joints[:, 0].mean(0)
    return find_scale(path, clip.points, skin, 8, np.full(len(skin), 400.0), up[None] / np.linalg.norm(up))


def test_feet_that_are_never_in_the_picture_are_guessed_from_where_the_person_stands_tallest():
    clip = bodyfit_clips.make(MODEL, frames=8)
    seen, _ = scale_of(clip, skin_of(clip))
    cut, floor = scale_of(clip, skin_of(clip), (480, 400))  # the picture ends at the hips
    assert "taken for straight" in cut["how"] and "taken for straight" not in seen["how"]
    assert floor is not None and cut["initial"] == pytest.approx(clip.scale, rel=0.02)
    assert cut["floor_spread"] > seen["floor_spread"] + 0.05


def test_frames_in_which_the_body_is_seen_from_its_end_do_not_tell_the_scale():
    clip = bodyfit_clips.make(MODEL, frames=8)
    skin = skin_of(clip)
    true = scale_of(clip, skin)[0]["initial"]
    away = skin.mean(1, keepdims=True)
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    about = skin - skin.mean(1, keepdims=True)
    lying = (
        skin.mean(1, keepdims=True) * 1.2 + (about * away).sum(-1, keepdims=True) * away + 0.3 * about
    )  # and too far
    mixed = np.concatenate([skin[:3], lying[3:]])
    assert scale_of(clip, mixed)[0]["initial"] == pytest.approx(true, rel=0.02)
    assert lengths_across(mixed)[3:].max() < LONG * lengths_across(mixed)[:3].min()
    assert scale_of(clip, lying)[0]["initial"] != pytest.approx(true, rel=0.05), "where nothing else is there, they do"


def test_a_body_at_the_camera_has_a_finite_length():
    assert np.isfinite(lengths_across(np.eye(3)[None] + [0, 0, 1e-3])).all()


def test_j04_no_floor_among_few_or_upright_points():
    clip = bodyfit_clips.make(MODEL, frames=6)
    feet = np.full((6, 4, 2), 300.0)
    args = (clip.cameras.viewmats, clip.cameras.Ks, feet, np.full(6, 400.0))
    assert find_floor(clip.points[:10], *args, np.array([[0, 1.0, 0]])) is None
    assert find_floor(np.zeros((0, 3)), *args, np.array([[0, 1.0, 0]])) is None


def test_j02_standing_feet_give_the_scale_without_a_floor():
    rng = np.random.default_rng(3)
    times = np.arange(30) / 12
    centers = np.cumsum(rng.normal(0, 0.1, (30, 3)), 0)
    place = np.array([0.3, -1.0, 2.0]) + np.array([[0, 0, 0], [0.2, 0, 0]])
    steps = np.zeros((30, 2, 3))
    steps[15:, 1] = [0.5, 0, 0]  # one foot makes a step
    feet = place + steps - 0.4 * centers[:, None] + rng.normal(0, 0.003, (30, 2, 3))
    scale, error = still_scale(feet, centers, times)
    assert scale == pytest.approx(0.4, rel=0.02) and error < 0.05
    assert still_scale(feet, np.zeros((30, 3)), times) is None


def test_height_of_a_floor_is_signed():
    floor = Plane(np.array([0, 1.0, 0]), -0.5, 30)
    np.testing.assert_allclose(floor.height(np.array([[0, 2.0, 0], [1, 0, 0]])), [1.5, -0.5])


@pytest.mark.parametrize("act", [bodyfit_clips.stand, sit, lie], ids=["stand", "sit", "lie"])
def test_who_sits_or_lies_all_the_time_is_on_the_floor_as_who_stands(act):
    clip = make(act)
    found, floor = told(clip, clip.points)
    assert floor is not None and "floor_refused" not in found
    assert found["initial"] == pytest.approx(1, abs=0.05)


def test_without_a_floor_feet_tell_the_scale():
    clip = make()
    found, floor = told(clip, walls(clip))
    assert floor is None and "standing feet" in found["how"]
    assert found["initial"] == pytest.approx(1, abs=0.08)


@pytest.mark.parametrize("height", [0.5, 0.8])
def test_a_table_before_the_legs_is_not_what_they_stand_on(height):
    clip = make()
    found, floor = told(clip, np.concatenate([walls(clip), table(clip, height)]))
    assert floor is None and found["floor_refused"] > 1.4
    assert found["initial"] == pytest.approx(1, abs=0.08)


def test_who_stands_on_a_table_does_not_stand_on_the_floor():
    clip = make(carried(lambda times: np.tile([0, 0.75, 0], (len(times), 1))))
    found, floor = told(clip, clip.points)
    assert floor is None and found["floor_refused"] < 0.6
    assert found["initial"] == pytest.approx(1, abs=0.08)


def test_a_slope_is_a_floor():
    clip = make(floor=slope)
    found, plane = told(clip, clip.points)
    assert plane is not None and found["initial"] == pytest.approx(1, abs=0.05)


def test_stairs_have_one_scale_although_they_are_no_plane():
    clip = make(climb, stairs)
    assert told(clip, clip.points)[0]["initial"] == pytest.approx(1, abs=0.1)


def test_the_floor_tells_the_scale_of_who_goes_by_on_a_skateboard():
    """Feet on it go along with the camera, and say 0.4; the board's 10 cm count as legs."""
    clip = make(carried(on_board))
    found, floor = told(clip, clip.points)
    assert abs(found["from_still_feet"] - 1) > 0.4
    assert floor is not None and found["initial"] == pytest.approx(1, abs=0.1)


def test_who_is_in_the_air_all_the_time_is_not_put_on_the_floor():
    """The scale that most frames agree on was an eighth of the true one."""
    clip = make(carried(on_trampoline))
    found, floor = told(clip, clip.points)
    assert floor is None and found["floor_spread"] > 0.3
    assert 0.7 < found["initial"] < 1.4


def test_feet_that_are_never_in_view_are_guessed_and_that_is_said():
    clip = make()
    found, floor = told(clip, clip.points, 450)
    assert floor is not None and "taken for straight" in found["how"]
    assert found["initial"] == pytest.approx(1, abs=0.05) and found["floor_spread"] >= 0.1


def test_soles_are_a_shoe_above_the_floor():
    clip = make()
    floor = told(clip, clip.points)[1]
    low = (clip.vertices.astype(np.float64) @ floor.normal).min(1) + floor.offset * clip.scale
    assert np.median(low) == pytest.approx(SOLE, abs=0.01)

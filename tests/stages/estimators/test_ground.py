"""The floor under a person: of a furnished room, of a slope, of no room at all; and what must not be taken for it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.estimators.ground import find_ground, plane_of_bodies, plane_of_scene

TILT = Rotation.from_euler(
    "xyz", [170, 25, -12], degrees=True
)  # room -> world: SfM's axes, the camera looking down a little
SHIFT = np.array([0.4, -1.1, 3.0])
UP = TILT.apply([0, 1, 0])
FRAMES = 40


def world(room):
    return TILT.apply(np.reshape(room, (-1, 3))).reshape(np.shape(room)) + SHIFT


def square(rng, count, middle, half, noise=0.005):
    """Points of a flat box, y up."""
    return middle + rng.uniform(-1, 1, (count, 3)) * half + rng.normal(0, noise, (count, 3))


def soles(rng, walk=0.3, jump=0.0):
    """Points of the soles of somebody who goes `walk` m to and fro, one foot up at a time, and may jump."""
    t = np.linspace(0, 1, FRAMES)
    place = np.stack([walk * np.sin(6 * t), 0 * t, walk * np.cos(5 * t)], 1)
    lift = np.stack([0.1 * np.maximum(0, np.sin(30 * t)), 0.1 * np.maximum(0, -np.sin(30 * t))], 1)
    lift += jump * (np.abs(t - 0.5) < 0.1)[:, None]
    feet = place[:, None] + np.array([[0.1, 0, 0], [-0.1, 0, 0]])
    feet[..., 1] += lift
    points = feet[:, :, None] + rng.uniform(-1, 1, (2, 20, 3)) * [0.04, 0, 0.1]
    return world(points.reshape(FRAMES, -1, 3) + rng.normal(0, 0.005, (FRAMES, 1, 3)) + [0, 0.012, 0])


def ups(lean=0.0):
    """Up as the cameras tell it, 8 degrees off, and as a body that leans tells it."""
    room = np.stack([Rotation.from_euler("x", angle, degrees=True).apply([0, 1, 0]) for angle in (8, lean)])
    return TILT.apply(room)


def furniture(rng):
    """A table above, a rug's worth of clutter, a wall and things under the floor, as SfM sees reflections."""
    return [
        square(rng, 900, [1.2, 0.75, 0.4], [0.6, 0.005, 0.5]),
        square(rng, 1500, [0, 1.2, -2.2], [2.5, 1.2, 0.01]),
        square(rng, 300, [-1, 0.2, 1], [0.4, 0.2, 0.3]),
        square(rng, 200, [0, -0.8, 0], [2, 0.7, 2]),
    ]


def angle(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


@pytest.mark.parametrize("seed", [0, 1])
def test_the_floor_of_a_furnished_room_is_found(seed):
    rng = np.random.default_rng(seed)
    things = world(np.concatenate([square(rng, 700, [0.3, 0, 0.2], [2.4, 0, 2.0]), *furniture(rng)]))
    plane = plane_of_scene(things, soles(rng, jump=0.5), ups(lean=12))
    assert angle(plane.normal, UP) < 0.2 and abs(plane.height(SHIFT)) < 0.004
    assert plane.tilt_error < np.radians(0.4) and plane.height_error < 0.005 and 600 < plane.members < 1000


def test_a_slope_is_a_floor_and_so_is_half_of_one():
    rng = np.random.default_rng(2)
    floor = square(rng, 300, [1.0, 0, 0], [0.9, 0, 1.2])
    plane = plane_of_scene(world(floor), soles(rng), ups())
    assert angle(plane.normal, UP) < 0.5, "the cameras are held 8 degrees off"


def test_no_table_no_wall_and_no_dozen_points_are_a_floor():
    rng = np.random.default_rng(3)
    table, wall, clutter, _ = furniture(rng)
    for things in ([table], [wall], [clutter], [square(rng, 20, [0, 0, 0], [1, 0, 1])], [np.zeros((0, 3))]):
        assert plane_of_scene(world(np.concatenate(things)), soles(rng), ups()) is None


def test_without_a_scene_the_floor_is_told_by_soles_that_go_far():
    plane = plane_of_bodies(soles(np.random.default_rng(4), walk=1.5, jump=0.5), ups(lean=15), np.radians(15))
    assert angle(plane.normal, UP) < 1.2 and abs(plane.height(SHIFT)) < 0.03
    assert np.radians(0.3) < plane.tilt_error < np.radians(3)


def test_soles_of_one_spot_leave_it_to_cameras_and_bodies():
    on_the_spot = soles(np.random.default_rng(5), walk=0.02)
    level = plane_of_bodies(on_the_spot, ups(lean=-8), np.radians(8))
    assert angle(level.normal, UP) < 3, "one leans as far ahead as the other back"
    trusted = plane_of_bodies(on_the_spot, ups(lean=0), np.radians(30))
    assert angle(trusted.normal, UP) < 2.5, "the camera hardly tells"
    assert trusted.tilt_error > np.radians(3)


def test_the_ground_is_below_the_person_and_looks_as_they_do():
    rng = np.random.default_rng(6)
    turns = (TILT * Rotation.from_euler("yx", [[40, 10]] * FRAMES, degrees=True)).as_matrix()
    views = np.tile(np.eye(4), (3, 1, 1))
    views[:, :3, :3] = Rotation.from_matrix(np.diag([1.0, -1, -1])).as_matrix() @ TILT.inv().as_matrix()
    things, pelvis = world(square(rng, 700, [0.3, 0, 0.2], [2.4, 0, 2.0])), world(np.array([0.2, 1.0, 0.1]))
    ground = find_ground(things, soles(rng), turns, pelvis, turns[0], views, 0.06)
    np.testing.assert_allclose(ground.point, world(np.array([0.2, 0, 0.1])), atol=0.01)
    np.testing.assert_allclose(
        TILT.inv().apply(ground.ahead), [np.sin(np.radians(40)), 0, np.cos(np.radians(40))], atol=0.01
    )
    assert ground.metres == 0.06 and ground.points > 500 and "scene" in ground.how
    guessed = find_ground(np.zeros((0, 3)), soles(rng), turns, pelvis, turns[0], views, 0.06)
    assert guessed.points == 0 and guessed.how.startswith("guessed from the bodies")
    assert guessed.tilt_error > 5 * ground.tilt_error

"""Scenes of other programs: which way up they stand, and that it is said where one lies on its head."""

import numpy as np
import pytest

from stages.avatar.splats.turn import OVER, turned
from stages.filming.scenes import on_its_head, stood
from stages.records import Ground, Scene
from tests.made.said import holds

GROUND = Ground(np.array([0.3, 1.2, 2.0]), np.array([0, -1.0, 0]), np.array([0, 0, -1.0]), 1.0, 0.0, 0.0, 0, "given")


def room(n=4000, floor=0.2):
    """A room with y down whose cameras are at the origin: a floor at 1.2, walls and things above."""
    rng = np.random.default_rng(0)
    means = rng.uniform([-3, -1.3, 0.5], [3, 1.2, 6], (n, 3))
    means[: int(floor * n), 1] = 1.2 + rng.normal(0, 0.02, int(floor * n))
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return Scene(means, quats, np.full((n, 3), 0.05), np.full(n, 0.9), np.zeros((n, 3)), np.zeros((n, 0, 3)))


def test_a_scene_with_y_up_is_said_to_lie_on_its_head_until_it_is_turned():
    scene = room()
    assert stood(scene, "y_down", GROUND).said == ()
    (said,) = stood(turned(scene, OVER), "y_down", GROUND).said
    assert holds(said, "upside down", "--scene-axes y_up")
    right = stood(turned(scene, OVER), "y_up", GROUND)
    assert right.said == ()
    np.testing.assert_allclose(right.means, scene.means, atol=1e-6)
    (said,) = stood(scene, "y_up", GROUND).said
    assert "--scene-axes y_down" in said


@pytest.mark.parametrize("tilt", [-15, 0, 15])
def test_a_floor_that_is_not_level_and_little_of_it_is_enough(tilt):
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    scene = turned(room(floor=0.15), turn)
    point, up = turn @ [0.3, 1.2, 2.0], turn @ [0, -1.0, 0]
    ground = Ground(point, up, turn @ [0, 0, -1.0], 1.0, 0.0, 0.0, 0, "given")
    assert not on_its_head(scene, ground) and on_its_head(turned(scene, OVER), ground)


def test_nothing_is_said_where_no_floor_is_known_or_seen():
    scene = turned(room(), OVER)
    assert stood(scene, "y_down", None).said == ()
    elsewhere = Ground(np.array([50.0, 1.2, 2.0]), GROUND.up, GROUND.ahead, 1.0, 0.0, 0.0, 0, "given")
    assert not on_its_head(scene, elsewhere)

"""Where people stand whom the film puts nowhere: near by, beside each other for the camera, and in nothing of the scene."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.model.scene import load_scene
from stages.filming.setting import Setting
from stages.filming.spec import Film, Person
from stages.filming.standing import APART, CLOSE, SHOWN, _in_the_way, free_places, views_of
from stages.records import Ground, Scene

LEVEL = Ground(np.zeros(3), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), 1, 0, 0, 0, "")
ANN, BOB = Path("ann"), Path("bob")


def setting_of(*things: tuple[float, float, float, float], seen: bool = True, ground: Ground = LEVEL) -> Setting:
    """A level place before a camera 5 m ahead of the middle; of `things` each is an upright sheet from x to x at z, y to 1.8 m
    (x, x, z, opacity)."""
    means = np.concatenate([np.zeros((0, 3)), *(sheet(*thing[:3]) for thing in things)]) @ ground.turn.T + ground.point
    opacities = np.concatenate([np.zeros(0), *(np.full(len(sheet(*thing[:3])), thing[3]) for thing in things)])
    count = len(means)
    quats, scales = np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), 0.06)
    scene = Scene(means, quats, scales, opacities, np.zeros((count, 3)), np.zeros((count, 0, 3)))
    eye, target = (ground.point + ground.turn @ np.array(one) for one in ((0, 1.0, 5.0), (0, 1.0, 0)))
    view = look_at(eye, target, ground.up)
    clip = SimpleNamespace(names=("a",), width=640, height=360, viewmats=view[None], Ks=pinhole(320, 640, 360)[None])
    splats = load_scene(scene, "cpu") if count else None
    return Setting(scene, splats, ground, None, clip if seen else None, np.zeros(1), ())


def sheet(left: float, right: float, z: float) -> np.ndarray:
    across, up = np.meshgrid(np.arange(left, right, 0.1), np.arange(0.05, 1.8, 0.1))
    return np.stack([across.ravel(), up.ravel(), np.full(across.size, z)], -1)


def placed(setting: Setting, *people: Person, starts: list | None = None) -> list[tuple[float, float]]:
    return free_places(Film(scene=ANN, people=list(people)), starts or [(0, 0)] * len(people), setting)


def test_where_nothing_is_they_stand_side_by_side():
    assert placed(setting_of(), Person(avatar=ANN), Person(avatar=BOB)) == [(0, 0), (1, 0)]
    three = placed(setting_of(), *(Person(avatar=BOB, motion="wave") for _ in range(3)))
    assert three == [(0, 0), (1, 0), (-1, 0)]
    slope = Ground(np.array([3.0, 1, -2]), np.array([0, -1.0, 0]), np.array([0.6, 0, -0.8]), 1, 0, 0, 0, "")
    assert placed(setting_of(ground=slope), Person(avatar=ANN), Person(avatar=BOB)) == [(0, 0), (1, 0)]


def test_who_is_put_somewhere_stays_there_and_the_others_keep_away():
    people = [Person(avatar=BOB), Person(avatar=ANN, at=(0.25, 0)), Person(avatar=BOB, at=(1.25, 0), motion="wave")]
    first, *others = placed(setting_of(), *people)
    assert others == [(0.25, 0), (1.25, 0)] and all(np.hypot(*np.subtract(first, one)) >= APART for one in others)


def test_the_scenes_own_people_are_where_they_were():
    wall = (-0.4, 0.4, 0.0, 0.9)
    assert placed(setting_of(wall), Person(avatar=BOB, at=(0.5, 0)), Person(avatar=ANN))[1] == (0, 0)
    people = [Person(avatar=BOB), Person(avatar=ANN, motion="wave"), Person(avatar=ANN, who=2)]
    assert placed(setting_of(), *people) == [(1, 0), (0, 0), (0, 0)]


def test_those_of_one_clip_stay_together_and_their_copies_do_not_coincide():
    pair = [Person(avatar=BOB), Person(avatar=BOB, who=2)]
    assert placed(setting_of(), Person(avatar=ANN), *pair) == [(0, 0), (1, 0), (1, 0)]
    assert placed(setting_of(), Person(avatar=ANN), *pair, *pair) == [(0, 0), (1, 0), (1, 0), (-1, 0), (-1, 0)]
    waving = [Person(avatar=BOB, who=2, motion="wave"), Person(avatar=ANN), Person(avatar=BOB)]
    assert len(set(placed(setting_of(), *waving))) == 3


def test_a_motion_that_begins_elsewhere_is_kept_apart_from_where_it_begins():
    people = Person(avatar=ANN), Person(avatar=BOB)
    assert placed(setting_of(), *people, starts=[(0, 0), (-0.9, 0)])[1] == (0, 0), "he begins 0.9 m to the right of it"
    assert placed(setting_of(), *people, starts=[(0.5, 0), (0, 0)])[1] == (-0.5, 0), "she begins 0.5 m to the left"


@pytest.mark.parametrize("seen", [True, False])
def test_nobody_is_put_into_something_of_the_scene(seen):
    wall = (0.5, 2.4, 0.0, 0.9)
    assert placed(setting_of(wall, seen=seen), Person(avatar=ANN), Person(avatar=BOB))[1] == (-1, 0)
    faint = (0.5, 2.4, 0.0, 0.02)
    assert placed(setting_of(faint, seen=seen), Person(avatar=ANN), Person(avatar=BOB))[1] == (1, 0)


def test_nobody_is_put_behind_something_nor_before_or_behind_another():
    curtain = (0.2, 2.0, 1.5, 0.9)
    assert placed(setting_of(curtain), Person(avatar=ANN), Person(avatar=BOB))[1] == (-1, 0)
    assert placed(setting_of(curtain, seen=False), Person(avatar=ANN), Person(avatar=BOB))[1] == (1, 0)
    walls = ((0.45, 2.4, 0.0, 0.9), (-2.4, -0.45, 0.0, 0.9))
    x, _ = placed(setting_of(*walls), Person(avatar=ANN), Person(avatar=BOB))[1]
    assert abs(x) > 0.3, "between the walls, one would hide the other"


def test_nobody_is_put_close_before_the_camera():
    walls = [(-2.4, 2.4, z, 0.9) for z in np.arange(-2.4, 0.9, 0.2)]
    _, z = placed(setting_of(*walls), Person(avatar=ANN), Person(avatar=BOB))[1]
    assert z < 1.3, "1.4 times as near as she is, whose nearest point is 4.7 m away"


def test_where_everything_is_full_it_is_the_place_with_least_in_the_way():
    full = [(-3.0, 3.0, z, 0.9) for z in np.arange(-2.4, 2.5, 0.2)] + [
        (-3.0, -0.4, z, 0.9) for z in np.arange(-2.3, 2.4, 0.2)
    ]
    x, _ = placed(setting_of(*full, seen=False), Person(avatar=ANN), Person(avatar=BOB))[1]
    assert x > 0


def in_the_way(spot: tuple[float, float], *taken: tuple[float, float]) -> float:
    return _in_the_way(spot, taken, setting_of(), views_of(setting_of(), 1))


def test_who_stands_before_another_hides_them_however_near_the_camera_is():
    people = Person(avatar=ANN, at=(0, 2.5)), Person(avatar=BOB)
    assert abs(placed(setting_of(), *people)[1][0]) > 0.3, "she stands 2.2 m before the camera, 5 m away"
    assert in_the_way((0, 0), (0, 2.5)) > 1 > in_the_way((2.0, 0), (-1.2, 2.5))
    assert in_the_way((2.0, 0), (0, 4.9)) < 1, "who stands in the camera hides nobody"


@pytest.mark.parametrize("z", [1.5, 2.0, 2.5])
def test_who_is_much_nearer_to_the_camera_than_another_fills_the_picture(z):
    assert in_the_way((1.0, z), (-1.5, 0)) == pytest.approx((5 - 0.3) / (5 - 0.3 - z) / CLOSE)
    assert in_the_way((-1.5, 0), (1.0, z)) < 1, "who is farther away does not"


def test_half_out_of_the_picture_is_worse_than_a_little():
    far = {x: in_the_way((x, 0)) for x in (3.0, 4.6, 4.8, 5.0, 5.2)}
    assert far[3.0] < 1 and (np.diff(list(far.values())) >= 0).all()
    assert 1 < far[5.0] < np.inf and far[5.2] > 1 / (1 - SHOWN) / 2 and in_the_way((9.0, 0)) == np.inf

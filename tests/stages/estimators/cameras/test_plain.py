"""Cameras before walls without corners: those that stand, those that move a little, and where nothing shows it."""

import numpy as np
import pytest

from stages.estimators.cameras.plain import Plain, Views, judge, look, standing_part
from tests.made.walls import (
    BLANK,
    BUMP,
    CLOTH,
    DARK,
    DEFOCUSED,
    DUST,
    FLOOR,
    HEIGHT,
    SPOT,
    STILL,
    SWAY,
    WIDTH,
    X,
    Y,
    film_wall,
)

VIGNETTE = 1 - 0.2 * ((X - WIDTH / 2) ** 2 + (Y - HEIGHT / 2) ** 2) / (WIDTH / 2) ** 2


def curtain(image: np.ndarray, frame: int) -> None:
    image[:150, 40:280] = 100 + 50 * np.sin(X[:150, 40:280] / 5 + 2 * np.sin(frame))


def wide_curtain(image: np.ndarray, frame: int) -> None:
    image[:172] = 100 + 50 * np.sin(X[:172] / 5 + 2 * np.sin(frame))


def screen(image: np.ndarray, frame: int) -> None:
    image[12:138, 52:268] = 15
    image[20:130, 60:260] = CLOTH[50 * frame : 50 * frame + 110, :200]


def light(image: np.ndarray, frame: int) -> None:
    image *= 1 + 0.1 * np.sin(frame)


def corners_dark(image: np.ndarray, frame: int) -> None:
    image *= VIGNETTE


def film_bars(image: np.ndarray, frame: int) -> None:
    image[:] = CLOTH[40 + 9 * frame : 40 + 9 * frame + HEIGHT, 7 * frame : 7 * frame + WIDTH]
    image[:30], image[-30:] = 0, 0
    image[190:204, 30:150] = np.where(X % 12 < 6, 255, 0)[190:204, 30:150]  # a caption


def seen(folder, wall: np.ndarray, way: np.ndarray, change=None) -> Views:
    files = film_wall(folder, wall, way, change)
    return look(folder / "images", folder / "ignored", files)


@pytest.mark.parametrize(("wall", "change"), [
    (FLOOR, None), (FLOOR, light), (FLOOR, corners_dark), (FLOOR, screen), (DEFOCUSED, None),
])  # fmt: skip
def test_edges_that_stay_are_a_camera_that_stands(tmp_path, wall, change):
    found = judge(seen(tmp_path, wall, STILL, change))
    assert found.still and not found.moves and found.drift_px < 0.3


@pytest.mark.parametrize(("wall", "change"), [
    (FLOOR, None), (DUST, corners_dark), (DEFOCUSED, None), (SPOT, None), (FLOOR, curtain), (FLOOR, film_bars),
])  # fmt: skip
def test_a_camera_that_moves_a_little_is_not_called_still(tmp_path, wall, change):
    found = judge(seen(tmp_path, wall, 2 * SWAY if wall is SPOT else SWAY, change))
    assert found.moves and not found.still


@pytest.mark.parametrize(("wall", "way"), [(BLANK, STILL), (BLANK, SWAY), (DARK, STILL), (SPOT, STILL)])
def test_where_nothing_shows_it_neither_is_said(tmp_path, wall, way):
    found = judge(seen(tmp_path, wall, way))
    assert not found.still and not found.moves and found.facts() == {"displacement_px": None, "stays": None}


def test_a_curtain_over_most_of_the_picture_does_not_make_the_floor_below_it_brighter_and_darker(tmp_path):
    found = judge(seen(tmp_path, np.where(Y < 210, 120, 95).astype(np.float32), STILL, wide_curtain))
    assert not found.moves and found.cells >= 0.25 and found.drift_px < 0.3


def test_what_stays_in_a_few_places_leaves_doubt_and_all_over_the_picture_none():
    assert not Plain(stays=0.2, cells=0.3, drift_px=0.3, sways=False).still
    assert not Plain(stays=0.2, cells=0.3, drift_px=0.3, sways=False).moves
    assert Plain(stays=0.4, cells=0.5, drift_px=0.1, sways=False).still


def test_of_a_tripod_that_was_bumped_the_larger_part_stands(tmp_path):
    views = seen(tmp_path, FLOOR, BUMP)
    assert judge(views).moves and standing_part(views).tolist() == list(range(8))
    assert standing_part(seen(tmp_path / "hand", FLOOR, SWAY)) is None

"""A hole in a picture goes on as what is around it does, and planes stay planes."""

import numpy as np
import pytest

from stages.training.finishing.completion import complete, membrane

HEIGHT, WIDTH = 96, 128


def tiles(height=HEIGHT, width=WIDTH, side=8):
    """A checkerboard of two colours, with soft edges."""
    y, x = np.mgrid[:height, :width] * np.pi / side
    wave = 0.5 + 0.5 * np.tanh(3 * np.sin(y + 0.3) * np.sin(x + 0.3))
    return wave[..., None] * [0.8, 0.5, 0.2] + (1 - wave[..., None]) * [0.1, 0.2, 0.4]


def hole_at(rows, columns, height=HEIGHT, width=WIDTH):
    hole = np.zeros((height, width), bool)
    hole[slice(*rows), slice(*columns)] = True
    return hole


def test_a_pattern_goes_on_through_a_hole():
    picture, hole = tiles(), hole_at((30, 66), (50, 80))
    filled = complete(np.where(hole[..., None], 0.5, picture), hole)
    assert np.abs(filled - picture)[hole].mean() < 0.03, "measured 0.004; a mean colour is 0.3 off"
    assert np.array_equal(filled[~hole], picture[~hole].astype(np.float32))
    assert np.array_equal(filled, complete(np.where(hole[..., None], 1.0, picture), hole)), "nothing in a hole counts"


def test_floor_and_wall_meet_where_they_meet_beside_the_hole():
    rng = np.random.default_rng(0)
    picture = 0.1 * rng.random((HEIGHT, WIDTH, 3)) + np.where(np.arange(HEIGHT) < 40, 0.8, 0.2)[:, None, None]
    hole = hole_at((15, 75), (50, 75))
    filled = complete(picture, hole)
    assert (np.abs((filled[..., 0] > 0.55).sum(0)[50:75] - 40) <= 3).all()


@pytest.mark.parametrize(
    "hole", [hole_at((0, 30), (0, 30)), hole_at((60, 96), (100, 128)), hole_at((20, 60), (0, 128))]
)
def test_a_hole_may_touch_the_border(hole):
    filled = complete(tiles(), hole)
    assert np.abs(filled - tiles())[hole].mean() < 0.1 and np.isfinite(filled).all()


def test_a_hole_that_fills_all_small_pictures_is_filled_in_a_larger_one():
    hole = np.ones((HEIGHT, WIDTH), bool)
    hole[:, :12] = False
    filled = complete(tiles(), hole)
    assert np.isfinite(filled).all() and filled[hole].std() > 0.1


@pytest.mark.parametrize(("size", "known"), [((40, 40), 0), ((40, 40), 6), ((6, 40), 30)])
def test_what_has_no_whole_patch_is_not_filled(size, known):
    hole = np.ones(size, bool)
    hole[:, :known] = False
    assert complete(np.zeros((*size, 3)), hole) is None


def test_without_a_hole_nothing_changes():
    assert np.array_equal(complete(tiles(), hole_at((0, 0), (0, 0))), tiles().astype(np.float32))


@pytest.mark.parametrize(
    "hole", [hole_at((30, 66), (50, 80)), hole_at((30, 31), (50, 51)), hole_at((20, 60), (40, 44))]
)
def test_a_plane_stays_a_plane(hole):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    plane = 0.2 + 0.003 * x - 0.001 * y
    assert np.allclose(membrane(np.where(hole, 7.0, plane), hole), plane, atol=1e-6)


def test_a_membrane_has_no_value_beyond_those_around():
    rng, hole = np.random.default_rng(0), hole_at((0, 40), (50, 128))
    values = rng.random((HEIGHT, WIDTH))
    filled = membrane(values, hole)
    assert filled.min() >= 0 and filled.max() <= 1 and np.array_equal(filled[~hole], values[~hole])
    assert np.array_equal(membrane(values, hole_at((0, 0), (0, 0))), values)
    assert (membrane(values, np.ones_like(hole)) == 0).all(), "nothing tells any"

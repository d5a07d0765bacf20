"""What goes from the lens's pictures to those of a pinhole camera."""

from __future__ import annotations

import numpy as np
import pytest

from stages.avatar.cameras.lens import distort, pinhole_focal, remap_grid
from stages.formats.datasets.undistorted import (
    _between_knots,
    _knots,
    lens_points,
    pinhole_points,
    read_lenses,
    write_undistorted,
)
from stages.formats.images import write_image, write_mask
from stages.formats.landmarks import read_landmarks, write_landmarks
from stages.records import SeenLandmarks

WIDTH, HEIGHT, FOCAL = 480, 270, 400.0
CENTER = np.array([WIDTH / 2 + 3, HEIGHT / 2 - 2])


@pytest.mark.parametrize("k", [-0.25, -0.05, 0.1, 0.4])
def test_points_lie_where_the_pinhole_picture_shows_them(k):
    pinhole = pinhole_focal(FOCAL, CENTER, k, WIDTH, HEIGHT)
    grid = remap_grid(FOCAL, CENTER, k, pinhole, WIDTH, HEIGHT)
    true = np.random.default_rng(0).uniform([5, 5], [WIDTH - 5, HEIGHT - 5], (50, 2))
    seen = distort((true - [WIDTH / 2, HEIGHT / 2]) / pinhole, k) * FOCAL + CENTER
    assert np.abs(pinhole_points(seen, grid) - true).max() < 0.01
    assert np.abs(seen - true).max() > 1, "the lens does move them"


def test_points_beyond_the_border_stay_beyond_it():
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    found = pinhole_points(np.array([[-30.0, 40.0], [WIDTH + 12.0, HEIGHT + 7.0]]), (x + 4, y))
    np.testing.assert_allclose(found, [[-34, 40], [WIDTH + 8, HEIGHT + 7]], atol=1e-3)


def test_landmarks_go_along_by_name_and_as_the_lens_moves_them(tmp_path):
    picture, mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
    for name in "abc":
        for kind in ("images", "masks"):
            (tmp_path / kind).mkdir(exist_ok=True)
        write_image(tmp_path / "images" / f"{name}.png", picture)
        write_mask(tmp_path / "masks" / f"{name}.png", mask)
    seen = [SeenLandmarks(np.full((33, 2), 100.0 + i), np.full(33, 0.5), np.ones((33, 3))) for i in range(2)]
    write_landmarks(tmp_path / "landmarks.npz", list("abc"), [seen[0], None, seen[1]])
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    list(write_undistorted(tmp_path, tmp_path, tmp_path / "out", ["b", "c"], {"b": None, "c": (x + 3, y)}.get))
    found = read_landmarks(tmp_path / "out" / "landmarks.npz")
    assert list(found) == ["b", "c"] and found["b"] is None
    np.testing.assert_allclose(found["c"].xy, np.tile([98.0, 101.0], (33, 1)), atol=1e-3)
    np.testing.assert_array_equal(found["c"].visibility, seen[1].visibility)
    lens_of = read_lenses(tmp_path / "out", WIDTH, HEIGHT)
    assert lens_of("b") is None
    np.testing.assert_allclose(lens_points(found["c"].xy, lens_of("c")), seen[1].xy, atol=1e-3)
    assert read_lenses(tmp_path, WIDTH, HEIGHT)("c") is None


def test_the_lens_that_is_kept_is_the_lens():
    grid = remap_grid(FOCAL, CENTER, -0.25, pinhole_focal(FOCAL, CENTER, -0.25, WIDTH, HEIGHT), WIDTH, HEIGHT)
    kept = np.stack([part[np.ix_(*map(_knots, part.shape))] for part in grid])
    assert kept.shape == (2, 18, 31) and np.abs(np.stack(_between_knots(kept, WIDTH, HEIGHT)) - grid).max() < 0.1

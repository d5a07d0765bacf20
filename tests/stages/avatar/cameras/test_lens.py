"""Lens distortion is inverted, and a folded lens is refused."""

import cv2
import numpy as np
import pytest

from stages.avatar.cameras import lens

SIZE = (480, 864)
CENTER = np.array([240.0, 432.0])


@pytest.mark.parametrize("k", [-0.2, -0.03, 0.0, 0.03, 0.3])
def test_a26_undistort_inverts_distort(k, held):
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    points[0] = 0
    held(np.abs(lens.undistort(lens.distort(points, k), k) - points).max(), 2e-15)


def test_a_lens_that_folds_over_is_refused():
    with pytest.raises(ValueError, match="folds over"):
        lens.undistort(np.array([[1.0, 0.5]]), -0.4)


@pytest.mark.parametrize("k", [-0.15, -0.02, 0.0, 0.02, 0.15])
def test_the_pinhole_image_has_no_blank_pixel_and_wastes_none(k):
    focal = lens.pinhole_focal(800, CENTER, k, *SIZE)
    x, y = lens.remap_grid(800, CENTER, k, focal, *SIZE)
    assert x.min() >= -0.5 and x.max() <= SIZE[0] - 0.5 and y.min() >= -0.5 and y.max() <= SIZE[1] - 0.5
    slack = min(x.min() + 0.5, SIZE[0] - 0.5 - x.max(), y.min() + 0.5, SIZE[1] - 0.5 - y.max())
    assert slack < 1.5  # one side reaches the edge of the source


def test_a21_a26_a_drawn_dot_lands_where_the_mathematics_says(held):
    """Pixel convention and exactness: dots drawn through the lens come back within 0.1 px of the pinhole projection."""
    focal, k, width, height = 300.0, 0.12, 240, 200
    center = np.array([width / 2, height / 2])
    pinhole = lens.pinhole_focal(focal, center, k, width, height)
    y, x = np.mgrid[:height, :width] + 0.5
    for ideal in np.array([[0.0, 0.0], [0.25, 0.2], [-0.28, 0.11], [0.1, -0.22]]):
        u, v = lens.distort(ideal, k) * focal + center
        seen = np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8).astype(np.float32)
        grid = lens.remap_grid(focal, center, k, pinhole, width, height)
        flat = cv2.remap(seen, *grid, cv2.INTER_CUBIC)
        found = np.array([(flat * x).sum(), (flat * y).sum()]) / flat.sum()
        held(np.abs(found - (ideal * pinhole + center)).max(), 0.1)


def test_a26_no_lens_samples_every_pixel_at_itself():
    x, y = lens.remap_grid(500, np.array([4.0, 3.0]), 0.0, 500, 8, 6)
    assert np.allclose(x, np.arange(8)[None]) and np.allclose(y, np.arange(6)[:, None])
    assert lens.max_shift(500, 0.0, 8, 6) == 0


def test_max_shift_is_the_corner():
    assert lens.max_shift(500, 0.1, 600, 800) == pytest.approx(0.1 * 500)  # radius 500 px is 1 focal length

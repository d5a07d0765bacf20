"""A zoom on a tripod, and motions that are none."""

import numpy as np
import pytest

from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.zooming import zoom_alone, zoom_of_edges
from tests.made.walls import BLANK, DEFOCUSED, DOOR, DUST, FLOOR, FRAMES, PAN, STILL, SWAY, film_wall

SIZE = (640, 480)
IN = 1 + 0.02 * np.arange(FRAMES)
FAST = 1.09 ** np.arange(FRAMES)
STOP = 1 + 0.03 * np.minimum(np.arange(FRAMES), 6)
TILT = np.arange(FRAMES)[:, None] * [0.0, 1.0]
ZOOM = np.array([1.0, 1.05, 1.12, 1.2, 1.31, 1.4])


def pairs_of(zoom: np.ndarray, way: float, depth: float = 0.0) -> list[Pair]:
    """Matches of points that a lens of `zoom` [F] sees from a camera that moves `way` px a frame, nearer ones by `depth` more."""
    rng = np.random.default_rng(1)
    points, near = rng.uniform(-0.4, 0.4, (60, 2)) * SIZE, rng.uniform(0, 1, 60)
    at = [scale * points + i * way * (1 + depth * near[:, None]) * [1, 0] for i, scale in enumerate(zoom)]
    seen = [np.add(place, np.array(SIZE) / 2) + rng.normal(0, 0.2, (60, 2)) for place in at]
    return [Pair(i, j, seen[i], seen[j]) for i in range(len(zoom)) for j in (i + 1, i + 2) if j < len(zoom)]


def test_a_zoom_is_known_to_a_thousandth_and_frames_that_nothing_joins_are_not():
    found = zoom_alone(pairs_of(ZOOM, 0.0), len(ZOOM) + 1, *SIZE)
    assert found[:-1] == pytest.approx(ZOOM, rel=1e-3) and np.isnan(found[-1])


@pytest.mark.parametrize(("way", "depth"), [(3.0, 0.0), (1.0, 2.0)])
def test_a_camera_that_also_moves_does_not_zoom_alone(way, depth):
    assert zoom_alone(pairs_of(ZOOM, way, depth), len(ZOOM), *SIZE) is None


def by_edges(folder, wall: np.ndarray, zoom: np.ndarray, way: np.ndarray = STILL) -> np.ndarray | None:
    files = film_wall(folder, wall, way, zoom=zoom)
    return zoom_of_edges(folder / "images", folder / "ignored", files)


@pytest.mark.parametrize("wall", [DUST, DOOR, DEFOCUSED])
@pytest.mark.parametrize("zoom", [IN, IN[::-1], STOP, FAST])
def test_a_zoom_before_dots_a_door_or_a_blurred_wall_is_known_to_half_a_percent(wall, zoom, tmp_path):
    found = by_edges(tmp_path, wall, zoom)
    assert found == pytest.approx(zoom / zoom[0], rel=5e-3)


@pytest.mark.parametrize(("wall", "zoom", "way"), [
    (DUST, IN, SWAY), (DUST, IN, PAN), (DUST, STILL[:, 0] + 1, SWAY), (DOOR, IN, SWAY), (DOOR, IN, PAN), (DEFOCUSED, IN, SWAY),
])  # fmt: skip
def test_by_edges_a_camera_that_moves_does_not_zoom_alone_either(wall, zoom, way, tmp_path):
    found = by_edges(tmp_path, wall, zoom, way)
    assert found is None or np.isfinite(found).mean() < 0.5


@pytest.mark.parametrize(("wall", "zoom", "way"), [
    (FLOOR, IN, STILL), (FLOOR, STILL[:, 0] + 1, TILT), (BLANK, IN, STILL), (DUST, STILL[:, 0] + 1, STILL),
])  # fmt: skip
def test_where_edges_show_no_zoom_or_a_tilt_as_well_none_is_found(wall, zoom, way, tmp_path):
    assert by_edges(tmp_path, wall, zoom, way) is None


def test_a_frame_in_which_the_tripod_is_bumped_has_no_zoom(tmp_path):
    found = by_edges(tmp_path, DOOR, IN, STILL + np.array([6.0, 4.0]) * (np.arange(FRAMES) == 9)[:, None])
    assert np.flatnonzero(np.isnan(found)).tolist() == [9] and found[10] == pytest.approx(IN[10], rel=5e-3)

"""A zoom on a tripod, and motions that are none."""

import numpy as np
import pytest

from stages.estimators.cameras.motion import Pair
from stages.estimators.cameras.zooming import zoom_alone

SIZE = (640, 480)
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

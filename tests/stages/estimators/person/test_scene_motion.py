"""How the static scene moves, against what the cameras of a drawn room say."""

import copy

import cv2
import numpy as np
import pytest

from stages.avatar.cameras.pinhole import camera_centers, pinhole
from stages.estimators.person.scene_motion import SceneMotion, spread, without_strays
from tests.made import rooms

K = pinhole(rooms.FOCAL, rooms.WIDTH, rooms.HEIGHT)
WINDOW = slice(60, 200), slice(90, 220)


@pytest.fixture(scope="module")
def walk():
    """Cameras of nine frames of a walk, and the motion of the scene in them; somebody hides a piece of each."""
    views = rooms.walk(9, 0.8)
    grey = [cv2.cvtColor(rooms.photograph(view, k=0.0), cv2.COLOR_RGB2GRAY) for view in views]
    hidden = np.zeros((9, rooms.HEIGHT, rooms.WIDTH), np.uint8)
    hidden[:, 80:180, 120:170] = 255
    for picture, mask in zip(grey, hidden):
        picture[mask > 0] = 30
    return views, SceneMotion(grey, list(hidden))


def true_places(views, frame, other):
    """Where pixels of the window lie in another frame, by the room's walls: [h,w,2]."""
    y, x = np.mgrid[WINDOW]
    rays = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], np.ones(x.shape)], -1)
    rays, eye = rays @ views[frame][:3, :3], camera_centers(views[frame])
    away = np.stack([(offset - eye @ normal) / (rays @ normal) for normal, offset, _ in rooms.WALLS])
    points = eye + rays * np.where(away > 0, away, np.inf).min(0)[..., None]
    local = points @ views[other][:3, :3].T + views[other][:3, 3]
    return (local @ K.T)[..., :2] / local[..., 2:] - 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("frame", "other", "most"), [(2, 4, 0.4), (4, 2, 1.0), (1, 8, 5.0)])
def test_the_scene_is_found_in_another_frame_also_behind_who_stays_in_the_picture(walk, frame, other, most):
    """Corners at the outline stay, too: where only eight neighbours judge a corner, the scene is 28, 29 and 110 px off there."""
    views, motion = walk
    truth, found = true_places(views, frame, other), motion.places(frame, other, *WINDOW)
    off = np.linalg.norm(np.stack(found, -1) - truth, axis=-1)
    assert np.percentile(off[20:120, 30:80], 75) < most  # px
    assert np.median(np.linalg.norm(truth - np.stack(np.mgrid[WINDOW][::-1], -1), axis=-1)) > 5


def test_frames_that_share_no_corners_tell_nothing():
    rng = np.random.default_rng(0)
    grey = [rng.integers(0, 256, (80, 80)).astype(np.uint8) for _ in range(2)]
    nobody = [np.zeros((80, 80), np.uint8)] * 2
    assert SceneMotion(grey, nobody).places(0, 1, slice(0, 80), slice(0, 80)) is None


def test_corners_that_move_by_no_common_way_tell_nothing(walk):
    motion, rng = copy.copy(walk[1]), np.random.default_rng(1)
    here, window = rng.uniform(0, 200, (14, 2)).astype(np.float32), (slice(0, 200), slice(0, 200))
    there = here + rng.normal(0, 12, here.shape).astype(np.float32)
    motion.corners = [(np.arange(14), here), (np.arange(14), there), (np.arange(14), here + np.float32(3))]
    assert motion.places(0, 1, *window) is None
    np.testing.assert_allclose(motion.places(0, 2, *window)[0][50], np.arange(200) + 3, atol=1e-2)


def test_motion_is_carried_to_every_pixel_and_a_stray_corner_is_left_out():
    y, x = (part.ravel() for part in np.mgrid[4:100:8, 4:120:8])
    points = np.stack([x, y], -1).astype(np.float32)
    motion = np.stack([0.02 * x, -0.01 * y], -1).astype(np.float32)
    motion[40] += 9
    kept, theirs = without_strays(points, motion)
    assert len(kept) == len(points) - 1 and not (kept == points[40]).all(1).any()
    rows, columns = slice(13, 90), slice(21, 101)
    v, u = np.mgrid[rows, columns]
    found = spread(kept, theirs, rows, columns)
    assert found.shape == (77, 80, 2) and abs(found - np.stack([0.02 * u, -0.01 * v], -1)).max() < 0.15
    assert not spread(points[:3], motion[:3], rows, columns).any()

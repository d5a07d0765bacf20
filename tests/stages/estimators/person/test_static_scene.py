"""Outlines corrected by the static scene, in a drawn room with true cameras."""

import cv2
import numpy as np
import pytest

from stages.avatar.cameras.pinhole import camera_centers, pinhole
from stages.estimators.person import static_scene
from stages.estimators.person.static_scene import corrected, inverse_depth
from stages.records import Cameras
from tests.made import rooms

COUNT = 9
K = pinhole(rooms.FOCAL, rooms.WIDTH, rooms.HEIGHT)


@pytest.fixture(scope="module")
def clip():
    """Pictures without a lens, cameras and wall points of a walk, the true masks, and masks with a blob and a cut."""
    lens, rooms.K1 = rooms.K1, 0.0
    try:
        views = rooms.walk(COUNT, 0.8)
        images = [rooms.photograph(view) for view in views]
    finally:
        rooms.K1 = lens
    patch, truth, guessed = rooms.texture(9) // 2 + np.array([120, 60, 0], np.uint8), [], []  # reddish
    for i, image in enumerate(images):
        mask, left = np.zeros((rooms.HEIGHT, rooms.WIDTH), np.uint8), 190 - 12 * i
        image[60:200, left : left + 50] = patch[100:240, 300:350]
        mask[60:200, left : left + 50] = 255
        wrong = mask.copy()
        wrong[95:135, left + 50 : left + 62] = 220  # of the room, rather sure
        wrong[60:80, left : left + 25] = 60  # a piece of the person is doubted
        truth.append(mask)
        guessed.append(cv2.GaussianBlur(wrong, (0, 0), 1.0))
    return (
        images,
        Cameras(tuple(map(str, range(COUNT))), views, np.tile(K, (COUNT, 1, 1)), *mask.shape[::-1]),
        truth,
        guessed,
    )


def points_of(cameras: Cameras) -> np.ndarray:
    """Where rays through a grid of pixels of some cameras meet the walls."""
    y, x = np.mgrid[4 : rooms.HEIGHT : 12, 4 : rooms.WIDTH : 12]
    found = []
    for view in cameras.viewmats[::4]:
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones(x.shape)], -1).reshape(-1, 3)
        rays, eye = rays @ view[:3, :3], camera_centers(view)
        away = np.stack([(offset - eye @ normal) / (rays @ normal) for normal, offset, _ in rooms.WALLS])
        nearest = np.where(away > 0, away, np.inf).min(0)
        found.append((eye + rays * nearest[:, None])[np.isfinite(nearest)])
    return np.concatenate(found)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return ((a > 127) & (b > 127)).sum() / ((a > 127) | (b > 127)).sum()


@pytest.mark.slow
def test_a_blob_goes_and_a_doubted_piece_comes_back(clip):
    images, cameras, truth, guessed = clip
    found = list(corrected(guessed, images, cameras, points_of(cameras)))
    before = [overlap(*pair) for pair in zip(guessed, truth)]
    after = [overlap(*pair) for pair in zip(found, truth)]
    assert max(before) < 0.88 and min(after) > 0.91 and np.mean(after) > 0.94  # a part is hidden in all other frames
    assert after[3] > 0.985  # all of it is shown by others


@pytest.mark.slow
def test_somebody_tall_is_compared_in_smaller_pictures_and_outlined_in_their_own(clip, monkeypatch):
    images, cameras, truth, guessed = clip
    sizes: list[tuple[int, int]] = []
    compared = static_scene._compared
    monkeypatch.setattr(static_scene, "_compared", lambda *given: sizes.append(given[1].shape) or compared(*given))
    monkeypatch.setattr(static_scene, "TALL", 70)  # of 140 px
    found = list(corrected(guessed, images, cameras, points_of(cameras)))
    assert set(sizes) == {(rooms.HEIGHT // 2, rooms.WIDTH // 2)} and found[0].shape == (rooms.HEIGHT, rooms.WIDTH)
    assert (
        min(overlap(*pair) for pair in zip(found, truth)) > max(overlap(*pair) for pair in zip(guessed, truth)) + 0.02
    )


@pytest.mark.slow
def test_without_points_a_moving_camera_teaches_less_than_with(clip):
    images, cameras, truth, guessed = clip
    at_infinity = list(corrected(guessed, images, cameras, np.zeros((0, 3))))
    with_points = list(corrected(guessed, images, cameras, points_of(cameras)))
    mean = [np.mean([overlap(*pair) for pair in zip(masks, truth)]) for masks in (at_infinity, with_points)]
    assert mean[0] < mean[1] - 0.01


@pytest.mark.slow
def test_a_standing_camera_needs_no_points(clip):
    images, cameras, truth, guessed = clip
    room = images[0].copy()
    room[truth[0] > 0] = images[-1][truth[0] > 0]
    still = []
    for image, mask in zip(images, truth):
        picture = room.copy()
        picture[mask > 0] = image[mask > 0]
        still.append(picture)
    cameras = Cameras(cameras.names, np.tile(np.eye(4), (COUNT, 1, 1)), cameras.Ks, cameras.width, cameras.height)
    found = list(corrected(guessed, still, cameras, np.zeros((0, 3))))
    after = [overlap(*pair) for pair in zip(found, truth)]
    assert min(after) > 0.92 and np.mean(after) > 0.96


def test_what_no_other_frame_shows_stays_as_it_was(clip):
    images, cameras, _, guessed = clip
    alone = Cameras(("0",), cameras.viewmats[:1], cameras.Ks[:1], cameras.width, cameras.height)
    empty = np.zeros_like(guessed[0])
    assert next(corrected(guessed[:1], images[:1], alone, points_of(cameras))) is guessed[0]
    found = list(corrected([guessed[0], empty], images[:2], cameras, points_of(cameras)))
    assert found[1] is empty  # nobody there


def test_the_depth_of_a_wall_is_found_between_its_points():
    size, whole = (rooms.WIDTH, rooms.HEIGHT), (slice(0, rooms.HEIGHT), slice(0, rooms.WIDTH))
    x, y = np.meshgrid(np.linspace(-4, 4, 30), np.linspace(-3, 3, 30))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 5.0)], 1)
    behind = wall * [1, 1, -1]  # behind the camera: never seen
    depth = inverse_depth(np.concatenate([wall, behind]), np.eye(4), K, size, whole)
    assert depth.shape == (rooms.HEIGHT, rooms.WIDTH) and np.allclose(depth, 0.2, atol=1e-5)
    nearer = wall * 0.5  # the same pixels, nearer: these count
    both = inverse_depth(np.concatenate([wall, nearer]), np.eye(4), K, size, whole)
    assert np.median(both) == pytest.approx(0.4, abs=0.01)
    part = (slice(13, 58), slice(29, 91))
    slope = np.concatenate([wall, wall + [0, 0, 1.5]]) @ [[1, 0, 0.2], [0, 1, 0.1], [0, 0, 1]]
    wide, narrow = (inverse_depth(slope, np.eye(4), K, size, window) for window in (whole, part))
    np.testing.assert_array_equal(narrow, wide[part])
    assert np.ptp(narrow) > 0.01
    nobody = inverse_depth(np.zeros((0, 3)), np.eye(4), K, size, part)
    assert nobody.shape == (45, 62) and not nobody.any()

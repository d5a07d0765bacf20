"""How the camera moved: static, only turning or travelling, by matches of made worlds."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras import lens
from stages.estimators.cameras.motion import (
    camera_rotations,
    fit_rotation_camera,
    judge_motion,
    rotations_between,
)
from tests.made.matches import FOCAL, FRAMES, HEIGHT, WIDTH, clip


def test_a_static_camera_is_named_even_with_moving_things_in_view():
    motion = judge_motion(clip(0, 0, outliers=0.3)[0], WIDTH, HEIGHT)
    assert motion.verdict == "static camera" and motion.displacement_px < 0.5


@pytest.mark.parametrize(("turn", "k"), [(14, 0.0), (14, -0.08), (14, 0.06), (3, 0.0)])
def test_i01_a_turning_camera_is_named_and_calibrated(turn, k, held):
    motion = judge_motion(clip(turn, 0, k=k, outliers=0.1)[0], WIDTH, HEIGHT)
    assert motion.verdict == "rotation only"
    held(motion.rotation_residual_px / motion.rotation_limit_px, 0.6)
    if turn > 10:
        assert motion.focal_px == pytest.approx(FOCAL, rel=0.03) and motion.k == pytest.approx(k, abs=0.03)


@pytest.mark.parametrize("travel", [0.05, 0.1])
def test_a_camera_that_travels_little_is_no_lens(travel):
    """What little depth shows is not explained by a lens that bends the picture."""
    focal, k, _ = fit_rotation_camera(clip(1.5, travel)[0], WIDTH, HEIGHT)
    assert lens.max_shift(focal, k, WIDTH, HEIGHT) < 0.5


def test_a_long_lens_that_turns_is_named():
    motion = judge_motion(clip(9, 0, focal=85 / 36 * WIDTH)[0], WIDTH, HEIGHT)
    assert motion.verdict == "rotation only" and motion.focal_px == pytest.approx(85 / 36 * WIDTH, rel=0.05)


@pytest.mark.parametrize(
    ("turn", "travel", "flat"), [(8, 0.8, False), (0, 0.5, False), (3, 0.2, False), (5, 0.8, True)]
)
def test_i01_i03_a_travelling_camera_is_not_taken_for_a_turning_one(turn, travel, flat, held):
    motion = judge_motion(clip(turn, travel, flat)[0], WIDTH, HEIGHT)
    assert motion.verdict == "moving"
    held(motion.rotation_limit_px / motion.rotation_residual_px, 1 / 1.5)


@pytest.mark.parametrize(("travel", "nearly"), [(0.15, True), (0.8, False)])
def test_a_camera_that_travels_little_nearly_turns(travel, nearly):
    motion = judge_motion(clip(8, travel)[0], WIDTH, HEIGHT)
    assert motion.verdict == "moving" and motion.nearly_turns is nearly


def test_i03_a_known_focal_length_is_kept():
    pairs, _ = clip(10, 0)
    focal, _, residuals = fit_rotation_camera(pairs[-20:], WIDTH, HEIGHT, FOCAL)
    assert focal == pytest.approx(FOCAL) and np.median(residuals) < 0.5


def test_rotations_are_found_in_the_first_camera_and_lonely_frames_are_marked():
    pairs, views = clip(14, 0)
    rotations, known = camera_rotations(pairs, FRAMES + 1, FOCAL, 0.0, WIDTH, HEIGHT)
    truth = views[:, :3, :3] @ views[0, :3, :3].T
    assert known[:-1].all() and not known[-1] and np.array_equal(rotations[-1], np.eye(3))
    off = Rotation.from_matrix(rotations[:-1] @ truth.mT).magnitude()
    assert np.degrees(off).max() < 0.1


def test_rotation_between_rays_ignores_outliers_and_never_mirrors():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(1, 60, 3)) * [0.3, 0.3, 0.05] + [0, 0, 1]
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    R = Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix()
    b = a @ R.T
    b[0, :6] = a[0, :6]
    found = rotations_between(a, b, 0.003)[0]
    assert np.abs(found - R).max() < 2e-3 and np.linalg.det(found) == pytest.approx(1)

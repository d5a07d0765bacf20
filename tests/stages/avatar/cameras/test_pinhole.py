"""Pinhole cameras in numpy and torch, and the similarity between two worlds."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.avatar.cameras import pinhole as cameras
from tests.made.worlds import align_viewmats, umeyama, unproject

K = np.array([[500.0, 0, 320], [0, 480.0, 200], [0, 0, 1]])
WORLD = cameras.look_at(np.array([1.0, 2, 3]), np.array([0.0, 0, 0]), np.array([0.0, 1, 0]))


def test_points_in_a_cameras_axes_lie_where_project_sees_them_and_near_ones_as_at_the_nearest_depth():
    points = np.array([[0.3, -0.2, 2.0], [0.3, -0.2, 0.01]])
    np.testing.assert_allclose(cameras.onto(points, K)[0], cameras.project(points, np.eye(4), K)[0][0])
    np.testing.assert_allclose(cameras.onto(points, K, 0.5)[1], [620, 8])
    assert torch.equal(cameras.onto(torch.tensor(points), torch.tensor(K)), torch.tensor(cameras.onto(points, K)))


def test_look_at_puts_the_target_in_the_middle_and_up_upwards():
    pixels, z = cameras.project(np.array([[0.0, 0, 0], [0, 0.1, 0]]), WORLD, K)
    assert np.allclose(pixels[0], [320, 200]) and z[0] == pytest.approx(14**0.5)
    assert pixels[1, 1] < 200 and pixels[1, 0] == pytest.approx(320)
    assert np.allclose(cameras.camera_centers(WORLD), [1, 2, 3])
    assert np.linalg.det(WORLD[:3, :3]) == pytest.approx(1)


def test_look_along_up_and_at_itself():
    down = cameras.look_at(np.array([0.0, 5, 0]), np.zeros(3), np.array([0.0, 1, 0]))
    assert np.allclose(down[:3, :3] @ down[:3, :3].T, np.eye(3)) and np.allclose(down[2, :3], [0, -1, 0])
    with pytest.raises(ValueError, match="own position"):
        cameras.look_at(np.ones(3), np.ones(3), np.array([0.0, 1, 0]))


def test_project_agrees_in_numpy_and_torch_and_unproject_inverts_it():
    points = np.random.default_rng(1).normal(size=(7, 3)) * 0.5
    pixels, z = cameras.project(points, WORLD, K)
    t_pixels, t_z = cameras.project(*(torch.from_numpy(a) for a in (points, WORLD, K)))
    assert np.allclose(pixels, t_pixels.numpy()) and np.allclose(z, t_z.numpy())
    assert np.allclose(unproject(pixels, z, WORLD, K), points)
    assert np.allclose(cameras.unproject(pixels, 1 / z, WORLD, K), points)
    assert np.allclose(unproject(t_pixels, t_z, torch.from_numpy(WORLD), torch.from_numpy(K)).numpy(), points)


def test_batches_of_cameras():
    points = np.random.default_rng(1).normal(size=(7, 3)) * 0.5
    viewmats = np.stack([WORLD, np.eye(4)])
    pixels, z = cameras.project(points, viewmats, K)
    assert pixels.shape == (2, 7, 2) and z.shape == (2, 7)
    assert np.allclose(pixels[0], cameras.project(points, WORLD, K)[0])


def test_c03_a_point_in_the_camera_plane_is_finite_in_value_and_gradient():
    points = torch.tensor([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, -1.0], [0.0, 0.0, 2.0]], dtype=torch.float64)
    points.requires_grad_()
    pixels, z = cameras.project(points, torch.eye(4, dtype=torch.float64), torch.from_numpy(K))
    pixels[z > 0.1].sum().backward()
    assert torch.isfinite(pixels).all() and torch.isfinite(points.grad).all()
    assert points.grad[3].abs().sum() > 0 and points.grad[:3].abs().sum() == 0


def test_first_pixel_centre_is_at_one_half():
    corner = unproject(np.array([[0.5, 0.5]]), np.array([1.0]), np.eye(4), cameras.pinhole(2.0, 4, 6))
    assert np.allclose(corner, [[(0.5 - 2) / 2, (0.5 - 3) / 2, 1]])


@settings(max_examples=30, deadline=None)
@given(
    st.floats(1e-3, 1e3),
    st.lists(st.floats(-3.14, 3.14), min_size=3, max_size=3),
    st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3),
)
def test_umeyama_finds_the_similarity_and_moves_cameras_with_it(scale, rotvec, shift):
    R, t = Rotation.from_rotvec(rotvec).as_matrix(), np.array(shift)
    source = np.random.default_rng(2).normal(size=(12, 3))
    target = scale * source @ R.T + t
    found, found_R, found_t = umeyama(source, target)
    assert found == pytest.approx(scale, rel=1e-6) and np.allclose(found_R, R, atol=1e-6)
    moved = align_viewmats(WORLD[None], found, found_R, found_t)[0]
    before, z = cameras.project(source * 0.1, WORLD, K)
    after, z_after = cameras.project(0.1 * scale * source @ R.T + t, moved, K)
    assert np.allclose(before, after, atol=1e-2) and np.allclose(z * scale, z_after, rtol=1e-5)


def test_j11_umeyama_never_mirrors_and_refuses_a_line():
    flat = np.random.default_rng(3).normal(size=(10, 3)) * [1, 1, 0]
    _, R, _ = umeyama(flat, flat * [-1, 1, 1])
    assert np.linalg.det(R) == pytest.approx(1)
    with pytest.raises(ValueError, match="one line"):
        umeyama(np.outer(np.arange(5.0), [1, 2, 3]), np.outer(np.arange(5.0), [1, 2, 3]))


def test_rescaled_world_gives_the_same_pixels():
    points = np.random.default_rng(1).normal(size=(7, 3)) * 0.5
    before, z = cameras.project(points, WORLD, K)
    after, z_after = cameras.project(points * 3, cameras.rescale_viewmats(WORLD[None], 3.0)[0], K)
    assert np.allclose(before, after) and np.allclose(z * 3, z_after)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_j11_points_that_are_not_finite_fix_no_rotation(bad):
    points = np.random.default_rng(0).normal(size=(5, 3))
    broken = points.copy()
    broken[2, 1] = bad
    for pair in ((broken, points), (points, broken)):
        with pytest.raises(ValueError, match="not finite"):
            umeyama(*pair)

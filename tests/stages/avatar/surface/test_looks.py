"""Cameras all around see all of a figure, from where they are said to stand."""

import numpy as np

from stages.avatar.surface.looks import RINGS, all_around


def test_every_camera_sees_every_point_and_the_first_stands_ahead():
    points = np.random.default_rng(0).uniform([-0.9, -1.2, -0.2], [0.9, 0.7, 0.3], (500, 3))
    cameras = all_around(points, 200)
    assert len(cameras) == sum(count for _, count, _ in RINGS)
    for camera in cameras:
        view, K = camera.viewmat.numpy(), camera.K.numpy()
        np.testing.assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view[:3, :3]) > 0
        local = points @ view[:3, :3].T + view[:3, 3]
        at = local[:, :2] / local[:, 2:] * np.diag(K)[:2] + K[:2, 2]
        assert local[:, 2].min() > 1 and at.min() > 0 and at.max() < 200
    eyes = [-(c.viewmat[:3, :3].T @ c.viewmat[:3, 3]).numpy() for c in cameras]
    assert eyes[0][2] > 2 and abs(eyes[0][0]) < 0.1, "before the figure, which faces z"
    up = cameras[0].viewmat.numpy()[:3, :3] @ [0, 1, 0]
    assert up[1] < -0.99, "y is up in the world, and down in the picture"

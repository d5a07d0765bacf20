"""The renderer of truth, against rays worked out by hand."""

import numpy as np
import pytest

from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.kernels.mesh import NO_LAMPS, _meet, cast, fill

K = pinhole(50.0, 40, 30)
DOWN = np.array([0.0, 1.0, 0.0])
PLAIN = 0.0, NO_LAMPS, False  # nothing mirrors, and the room is closed


def rays(width=40, height=30):
    """Directions [H,W,3] through the pixel centres, z = 1."""
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], -1)


def test_fill_hits_the_plane_of_a_slanted_triangle_where_the_ray_does():
    points = np.array([[-1.0, -0.8, 2.0], [1.2, -0.5, 5.0], [0.1, 1.0, 3.0]])
    depth, face, weights = fill(points, np.array([[0, 1, 2]]), K, 40, 30)
    hit = face == 0
    assert 100 < hit.sum() < 1000
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    along = points[0] @ normal / (rays() @ normal)
    assert np.allclose(depth[hit], along[hit], rtol=1e-12)
    assert np.allclose(weights[hit] @ points, (rays() * along[..., None])[hit], atol=1e-9)
    assert np.isinf(depth[~hit]).all()


def test_fill_keeps_the_nearer_of_two_triangles_in_either_order_and_either_winding():
    near = [[-1, -1, 2], [1, -1, 2], [0, 1, 2]]
    points = np.array(near + [[2 * x, 2 * y, 4] for x, y, _ in near], dtype=float)
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 5, 4], [0, 2, 1]]):
        depth, face, _ = fill(points, np.array(faces), K, 40, 30)
        assert set(depth[face >= 0].round(9)) == {2.0}


def test_fill_leaves_no_gap_between_triangles_that_share_an_edge():
    square = np.array([[-3, -3, 2], [3, -3.1, 3], [3, 3, 2.5], [-3, 2.9, 4.0]])
    _, face, _ = fill(square, np.array([[0, 1, 2], [0, 2, 3]]), K, 40, 30)
    assert set(np.unique(face)) == {0, 1}


def test_fill_refuses_what_is_behind_the_camera():
    with pytest.raises(ValueError, match="behind"):
        fill(np.array([[0, 0, -1.0], [1, 0, 2], [0, 1, 2]]), np.array([[0, 1, 2]]), K, 40, 30)


@pytest.mark.slow
def test_cast_sees_the_wall_through_the_room_and_the_box_before_it():
    boxes = np.array([[0, 0, 0, 3, 2, 4, 1, 0], [0, 0, 2, 0.2, 5, 0.1, np.cos(0.3), np.sin(0.3)]], dtype=float)
    mips = tuple(np.full((1, s, s, 3), 0.5, np.float32) for s in (8, 4))
    pose = np.linalg.inv(look_at(np.zeros(3), np.array([0, 0, 1.0]), DOWN))[None]
    arguments = np.zeros((2, 6), int), np.ones((2, 3)), mips, 4.0, DOWN, *PLAIN
    image, depth = cast(pose, K, 40, 30, boxes[:1], *arguments)
    assert depth == pytest.approx(4.0, rel=1e-12), "the far wall fills the view"
    assert ((image > 0.2) & (image < 0.51)).all()
    _, depth = cast(pose, K, 40, 30, boxes, *arguments)
    assert depth[15, 20] == pytest.approx(2 - 0.1 / np.cos(0.3), abs=0.01)
    assert depth[15, 2] == 4.0


@pytest.mark.slow
def test_cast_leaves_no_box_out_that_a_ray_meets():
    """Turned boxes before, beside and around the camera, which rolls and moves from row to row."""
    rng = np.random.default_rng(0)
    boxes = np.array([[*rng.uniform(-2, 2, 3), *rng.uniform(0.05, 1, 3), np.cos(a), np.sin(a)] for a in range(12)])
    boxes[0] = [0, 0, 0, 5, 5, 5, 1, 0]
    poses = np.stack([np.linalg.inv(look_at(eye, rng.uniform(-1, 1, 3), DOWN)) for eye in rng.uniform(-2, 2, (30, 3))])
    mips = tuple(np.full((1, s, s, 3), 0.5, np.float32) for s in (8, 4))
    _, depth = cast(poses, K, 40, 30, boxes, np.zeros((12, 6), int), np.ones((12, 3)), mips, 4.0, DOWN, *PLAIN)
    met = [
        [min(_meet(tuple(pose[:3, 3]), tuple(pose[:3, :3] @ ray), boxes, i)[0] for i in range(12)) for ray in row]
        for pose, row in zip(poses, rays(), strict=True)
    ]
    assert depth == pytest.approx(np.array(met), rel=1e-9)


@pytest.mark.slow
def test_a_point_of_the_texture_is_one_colour_near_and_far():
    """Finer or coarser, looked at straight: the mean over a whole tile is the texture's mean."""
    rng = np.random.default_rng(0)
    fine = rng.random((1, 16, 16, 3)).astype(np.float32)
    coarse = fine.reshape(1, 8, 2, 8, 2, 3).mean((2, 4))
    coarser = coarse.reshape(1, 4, 2, 4, 2, 3).mean((2, 4))
    room = np.array([[0, 0, 0, 50, 50, 4, 1, 0]], dtype=float)
    pose = np.linalg.inv(look_at(np.zeros(3), np.array([0, 0, 1.0]), DOWN))[None]
    for focal in (64.0, 640.0):
        size = 32
        close = pinhole(focal, size, size)
        image, _ = cast(pose, close, size, size, room, np.zeros((1, 6), int), np.ones((1, 3)),
                        (fine, coarse, coarser), 8.0 * focal / 64, DOWN, *PLAIN)  # fmt: skip
        assert image.mean((0, 1)) == pytest.approx(0.72 * fine[0].mean((0, 1)), abs=0.02)

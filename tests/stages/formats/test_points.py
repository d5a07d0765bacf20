"""points.ply as other readers see it, and broken headers refused."""

import numpy as np
import pytest
import trimesh

from stages.contract import StageError
from stages.formats.points import read_points, write_points


def test_l07_round_trip_and_another_reader(tmp_path):
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(50, 3)).astype(np.float32) * [1, 1e-3, 1e6]
    rgb = rng.integers(0, 256, (50, 3), dtype=np.uint8)
    write_points(tmp_path / "points.ply", xyz, rgb)
    xyz_again, rgb_again = read_points(tmp_path / "points.ply")
    assert np.array_equal(xyz_again, xyz.astype(np.float32)) and np.array_equal(rgb_again, rgb)
    other = trimesh.load(tmp_path / "points.ply")
    assert np.allclose(other.vertices, xyz) and np.array_equal(np.asarray(other.colors)[:, :3], rgb)


def test_l05_no_points_is_a_valid_file(tmp_path):
    write_points(tmp_path / "points.ply", np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    xyz, rgb = read_points(tmp_path / "points.ply")
    assert xyz.shape == (0, 3) and rgb.shape == (0, 3)


def test_l08_broken_files_are_refused(tmp_path):
    path = tmp_path / "points.ply"
    write_points(path, np.ones((4, 3)), np.ones((4, 3), np.uint8))
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])
    with pytest.raises(StageError, match="cut short"):
        read_points(path)
    path.write_bytes(whole.replace(b"red", b"rot"))
    with pytest.raises(StageError, match="lacks"):
        read_points(path)
    path.write_bytes(b"solid cube")
    with pytest.raises(StageError, match="not a binary"):
        read_points(path)
    write_points(path, np.array([[np.nan, 0, 0]]), np.ones((1, 3), np.uint8))
    with pytest.raises(StageError, match="not finite"):
        read_points(path)
    with pytest.raises(ValueError, match="uint8"):
        write_points(path, np.ones((4, 3)), np.ones((4, 3)))


@pytest.mark.parametrize(
    ("old", "new", "fact"),
    [
        (b"vertex 4", b"vertex -4", "-4 rows of vertex"),
        (b"vertex 4", b"vertex many", "invalid literal"),
        (b"vertex 4", b"vertex", "out of range"),
        (b"float x", b"list uchar int x", "a property list"),
        (b"float y", b"float x", "'x'"),
        (b"element vertex 4\n", b"", "vertices"),
    ],
)
def test_headers_that_mean_nothing_are_refused(tmp_path, old, new, fact):
    path = tmp_path / "points.ply"
    write_points(path, np.ones((4, 3)), np.ones((4, 3), np.uint8))
    path.write_bytes(path.read_bytes().replace(old, new))
    with pytest.raises(StageError, match="the header of") as error:
        read_points(path)
    assert fact in error.value.facts[0]

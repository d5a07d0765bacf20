"""cameras.npz keeps every bit, and wrong cameras are refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.cameras import read_cameras, write_cameras
from stages.records import Cameras


def some_cameras() -> Cameras:
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    turn = 0.3
    viewmats[1, :2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    viewmats[1, :3, 3] = [1.0, 2.0, 3.0 + 1e-12]
    Ks = np.tile([[500.0, 0, 320], [0, 501.0, 240], [0, 0, 1]], (3, 1, 1))
    return Cameras(("000003", "000010", "frame 9 é"), viewmats, Ks, 640, 480)


def test_round_trip_keeps_every_bit(tmp_path):
    cameras = some_cameras()
    write_cameras(tmp_path / "cameras.npz", cameras)
    again = read_cameras(tmp_path / "cameras.npz")
    assert again.names == cameras.names and (again.width, again.height) == (640, 480)
    assert np.array_equal(again.viewmats, cameras.viewmats) and again.viewmats.dtype == np.float64
    assert np.array_equal(again.Ks, cameras.Ks)


def test_centers_are_where_the_camera_sees_zero():
    cameras = some_cameras()
    center = np.append(cameras.centers[1], 1.0)
    assert np.allclose(cameras.viewmats[1] @ center, [0, 0, 0, 1])


@pytest.mark.parametrize(
    ("change", "token"),
    [
        ({"viewmats": np.zeros((3, 4, 4))}, "camera 0"),
        ({"viewmats": np.tile(np.diag([1.0, 1, -1, 1]), (3, 1, 1))}, "camera 0"),
        ({"viewmats": np.full((3, 4, 4), np.nan)}, "camera 0"),
        ({"viewmats": np.tile(np.eye(4), (2, 1, 1))}, "shapes"),
        ({"Ks": np.tile(np.diag([-500.0, 500, 1]), (3, 1, 1))}, "focal"),
        ({"Ks": np.tile(np.diag([0.0, 500, 1]), (3, 1, 1))}, "focal"),
        ({"Ks": np.tile([[500.0, 2, 320], [0, 500, 240], [0, 0, 1]], (3, 1, 1))}, "skewed or transposed"),
        ({"Ks": np.tile([[500.0, 0, 0], [0, 500, 0], [320, 240, 1]], (3, 1, 1))}, "skewed or transposed"),
        ({"Ks": np.tile(np.diag([500.0, 500, 2]), (3, 1, 1))}, "skewed or transposed"),
        ({"names": np.array(["a", "a", "b"])}, "names"),
        ({"names": np.array(["a", "../../b", "c"])}, "camera name"),
        ({"width": None}, "width"),
        ({"width": 0}, "picture size"),
        ({"width": 1 << 16, "height": 1 << 16}, "memory"),
    ],
)
def test_k08_wrong_cameras_are_refused_by_name(tmp_path, change, token):
    write_cameras(tmp_path / "cameras.npz", some_cameras())
    arrays = dict(np.load(tmp_path / "cameras.npz")) | change
    np.savez(tmp_path / "cameras.npz", **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(StageError, match=token):
        read_cameras(tmp_path / "cameras.npz")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.diag([1.0, 1, -1]), ["off by 2", "determinant -1"]),
        (np.array([[1, 0.01, 0], [0, 1, 0], [0, 0, 1.0]]), ["off by 0.01", "determinant 1"]),
        (np.full((3, 3), np.nan), ["nan"]),
        (1.001 * np.eye(3), ["off by 0.003", "determinant 1.003"]),
    ],
    ids=["mirror", "shear", "nan", "scale"],
)
def test_d13_what_is_no_rotation_is_refused_with_numbers(tmp_path, change, words):
    good = some_cameras()
    viewmats = good.viewmats.copy()
    viewmats[1, :3, :3] = change @ viewmats[1, :3, :3]
    write_cameras(tmp_path / "cameras.npz", replace(good, viewmats=viewmats))
    with pytest.raises(StageError, match=r"\bcamera 1\b.*rotation") as refused:
        read_cameras(tmp_path / "cameras.npz")
    assert all(word in refused.value.facts[0] for word in words), refused.value.facts
    noise = 1e-5 * np.random.default_rng(0).uniform(-1, 1, viewmats.shape) * (np.arange(4) < 3)[:, None]
    write_cameras(tmp_path / "cameras.npz", replace(good, viewmats=good.viewmats + noise))
    assert len(read_cameras(tmp_path / "cameras.npz")) == 3


def test_a_camera_path_needs_no_names(tmp_path):
    cameras = some_cameras()
    np.savez(tmp_path / "path.npz", viewmats=cameras.viewmats, Ks=cameras.Ks, width=640, height=480)
    assert read_cameras(tmp_path / "path.npz").names == ("000000", "000001", "000002")


def test_not_an_archive(tmp_path):
    (tmp_path / "cameras.npz").write_text("hello")
    with pytest.raises(StageError, match="cannot read"):
        read_cameras(tmp_path / "cameras.npz")


def test_a_picture_of_8k_can_be_drawn(tmp_path):
    write_cameras(tmp_path / "cameras.npz", replace(some_cameras(), width=7680, height=4320))
    assert read_cameras(tmp_path / "cameras.npz").width == 7680

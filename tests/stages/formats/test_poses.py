"""body.npz comes back as written, and wrong poses are refused by key."""

from dataclasses import replace

import numpy as np
import pytest

from stages.contract import StageError
from stages.formats.body_model import FREE, SMPL
from stages.formats.poses import read_poses, whose, write_poses
from stages.records import BodyPoses


def some_poses(frames=3):
    rng = np.random.default_rng(0)
    return BodyPoses(
        names=tuple(f"{i:06d}" for i in range(0, 5 * frames, 5)),
        betas=rng.normal(size=10),
        global_orient=rng.normal(size=(frames, 3)),
        body_pose=rng.normal(size=(frames, 69)),
        transl=rng.normal(size=(frames, 3)),
        confidence=rng.random(frames),
        world_from_sfm=0.37,
    )


def test_what_is_written_comes_back(tmp_path):
    poses = some_poses()
    write_poses(tmp_path / "body.npz", poses)
    again = read_poses(tmp_path / "body.npz")
    assert again.names == poses.names and again.world_from_sfm == poses.world_from_sfm and len(again) == 3
    for name in ("betas", "global_orient", "body_pose", "transl", "confidence"):
        assert np.array_equal(getattr(again, name), getattr(poses, name))


def test_a_face_comes_back_and_one_of_too_few_shapes_is_refused(tmp_path):
    poses, face = some_poses(), np.random.default_rng(1).random((3, 52))
    write_poses(tmp_path / "body.npz", replace(poses, face=face))
    assert np.array_equal(read_poses(tmp_path / "body.npz").face, face)
    write_poses(tmp_path / "body.npz", replace(poses, face=np.tile(face, 2)))
    assert read_poses(tmp_path / "body.npz").face.shape == (3, 104)
    with pytest.raises(StageError, match=r"(?s)face.*51 shapes.*52"):
        write_poses(tmp_path / "wrong.npz", replace(poses, face=face[:, 1:]))
    write_poses(tmp_path / "body.npz", poses)
    assert read_poses(tmp_path / "body.npz").face is None


@pytest.mark.parametrize("dtype", [">f8", "<f4", "f2"])
def test_k07_any_float_is_read(tmp_path, dtype):
    poses = some_poses()
    arrays = {
        k: np.asarray(v).astype(dtype)
        for k, v in vars(poses).items()
        if k not in ("names", "confidence", "hands", "face")
    }
    np.savez(tmp_path / "body.npz", names=np.array(poses.names), **arrays)
    again = read_poses(tmp_path / "body.npz")
    assert np.allclose(again.body_pose, poses.body_pose, atol=1e-6 if dtype != "f2" else 2e-3)
    assert again.body_pose.dtype == np.float64 and (again.confidence == 1).all()


@pytest.mark.parametrize(
    "change,words",
    [
        ({"body_pose": np.zeros((3, 63))}, ["body_pose", "3x63", "3x69"]),
        ({"transl": np.zeros((2, 3))}, ["transl", "2x3", "3x3"]),
        ({"betas": np.zeros((1, 10))}, ["betas", "1x10"]),
        ({"transl": np.array([[0, 0, 0], [0, np.inf, 0], [0, 0, 0]])}, ["transl", "[1, 1]", "inf"]),
        ({"world_from_sfm": np.array(0.0)}, ["world_from_sfm", "0.0"]),
        ({"names": np.array(["a", "b", "a"])}, ["names", "more than once: a"]),
        ({"global_orient": np.array([["x"] * 3] * 3)}, ["global_orient", "numbers"]),
    ],
)
def test_k01_k02_refuses_by_key(tmp_path, change, words):
    arrays = {k: np.asarray(v) for k, v in vars(some_poses()).items() if k not in ("hands", "face")} | change
    np.savez(tmp_path / "body.npz", **arrays)
    with pytest.raises(StageError) as caught:
        read_poses(tmp_path / "body.npz")
    said = "\n".join([caught.value.problem, *caught.value.facts])
    assert all(word in said for word in words), said


def test_a_missing_key_or_file_is_named(tmp_path):
    np.savez(tmp_path / "body.npz", names=np.array(["a"]))
    with pytest.raises(StageError, match="no world_from_sfm"):
        read_poses(tmp_path / "body.npz")
    with pytest.raises(StageError, match="no file"):
        read_poses(tmp_path / "none.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "body.npz").read_bytes()[:100])
    with pytest.raises(StageError, match="cannot read"):
        read_poses(tmp_path / "cut.npz")


@pytest.mark.parametrize("more,body", [({}, SMPL), ({"world_from_sfm": 1.0}, ""), ({"body": FREE}, FREE)])
def test_a_file_says_whose_poses_it_holds(more, body):
    assert whose({key: np.asarray(value) for key, value in more.items()}, "a.npz") == body


def test_a_body_that_is_no_name_is_refused():
    with pytest.raises(StageError, match="is no name"):
        whose({"body": np.zeros(3)}, "a.npz")

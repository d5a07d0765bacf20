"""Drawing what was learned: cameras and poses of one's own, the turntable's camera, a motion's place in the world."""

import numpy as np
import pytest

from stages.commands import views
from stages.contract import Job, StageError
from stages.formats.cameras import write_cameras
from stages.formats.images import read_pixels
from stages.formats.poses import write_poses
from stages.formats.splats import write_splats
from stages.records import Avatar, BodyPoses, Cameras, Scene
from tests.made.said import holds
from tests.made.skeleton import PARENTS

WIDTH, HEIGHT = 48, 40
RED, BLUE = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


def splats(means, size, rgb):
    n = len(means)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    sh0 = np.tile((rgb - 0.5) / 0.28209479, (n, 1))
    return {
        "means": means,
        "quats": quats,
        "scales": np.full((n, 3), size),
        "opacities": np.full(n, 0.99),
        "sh0": sh0,
        "shN": np.zeros((n, 0, 3)),
    }


@pytest.fixture
def train(tmp_path):
    """A red person of one Gaussian at the pelvis, in front of a blue wall."""
    folder = tmp_path / "train"
    folder.mkdir()
    weights = np.zeros((1, 24))
    weights[0, 0] = 1
    person = splats(np.zeros((1, 3)), 0.15, RED)
    skeleton = {"joints": np.zeros((24, 3)), "parents": np.array(PARENTS), "betas": np.zeros(10)}
    write_splats(folder / "avatar.npz", Avatar(**person, lbs_weights=weights, canonical_pose=np.zeros(69), **skeleton))
    x, y = np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-3, 3, 13))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], 1)
    write_splats(folder / "scene.npz", Scene(**splats(wall, 0.5, BLUE)))
    poses(folder / "body.npz", ("000000", "000005"), [[0, 0, 2.0], [0.4, 0, 2.0]])
    return folder


def poses(path, names, places):
    n = len(names)
    write_poses(
        path, BodyPoses(names, np.zeros(10), np.zeros((n, 3)), np.zeros((n, 69)), np.array(places), np.ones(n), 1.0)
    )


def cameras(path, names):
    K = np.array([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])
    n = len(names)
    write_cameras(path, Cameras(tuple(names), np.tile(np.eye(4), (n, 1, 1)), np.tile(K, (n, 1, 1)), WIDTH, HEIGHT))
    return path


def drawn(train, tmp_path, names, only, body=None):
    out = tmp_path / "out"
    notes = []
    cameras(tmp_path / "c.npz", names)
    job = Job(out, emit=lambda event: notes.append(event["text"]) if event["event"] == "note" else None)
    views.run(job, views.Params(only=only), train=train, cameras=tmp_path / "c.npz", poses=body)
    assert len(notes) == 1 and holds(notes[0], len(names), only)
    return [read_pixels(out / f"{name}.png") for name in names]


def column(picture):
    """Where the red is, in px from the left."""
    weight = picture[..., 0].astype(float) * picture[..., 3]
    return (weight.sum(0) @ (np.arange(WIDTH) + 0.5)) / weight.sum()


def test_a_camera_named_as_a_frame_shows_that_frames_pose(train, tmp_path):
    first, second = drawn(train, tmp_path, ["000000", "000005"], "human")
    assert column(first) == pytest.approx(24, abs=0.2)
    assert column(second) == pytest.approx(24 + 0.4 * 40 / 2, abs=0.2)


def test_colours_are_not_multiplied_by_alpha(train, tmp_path):
    (person,) = drawn(train, tmp_path, ["000000"], "human")
    faint = (person[..., 3] > 20) & (person[..., 3] < 120)
    assert faint.any() and (person[faint][:, 0] > 245).all() and (person[faint][:, 2] < 10).all()
    assert (person[0, 0] == 0).all()
    (both,) = drawn(train, tmp_path, ["000000"], "both")
    assert both[HEIGHT // 2, WIDTH // 2, 0] > 200 and both[HEIGHT // 2, 4, 2] > 200 and both[HEIGHT // 2, 4, 3] > 240
    (scene,) = drawn(train, tmp_path, ["000000"], "scene")
    assert scene[..., 0].max() < 10


def test_given_poses_are_one_or_one_each(train, tmp_path):
    body = tmp_path / "one.npz"
    poses(body, ("a",), [[-0.4, 0, 2.0]])
    assert [column(p) for p in drawn(train, tmp_path, ["x", "y"], "human", body)] == pytest.approx([16, 16], abs=0.2)
    poses(body, ("a", "b"), [[-0.4, 0, 2.0]] * 2)
    with pytest.raises(StageError, match="do not belong together") as refused:
        drawn(train, tmp_path, ["x", "y", "z"], "human", body)
    assert "3 cameras" in refused.value.facts[0] and "2 poses" in refused.value.facts[1]


def test_a_clip_without_a_scene_says_so(train, tmp_path):
    (train / "scene.npz").unlink()
    with pytest.raises(StageError, match="no scene") as refused:
        drawn(train, tmp_path, ["x"], "both")
    assert "--only human" in refused.value.hint
    assert len(drawn(train, tmp_path, ["x"], "human")) == 1

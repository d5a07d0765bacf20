"""The front for scripts: arrays that mean what they say, and pictures that show them."""

import numpy as np
import pytest
import torch

import hugs
from stages.avatar.body.rotations import matrix_from_quat
from stages.avatar.drawing.avatar import load_avatar, pose_avatar
from stages.contract import StageError
from stages.formats.images import read_image
from stages.formats.splats import read_avatar
from tests.made import tiny


@pytest.fixture(scope="module")
def train(tmp_path_factory):
    return tiny.make(tmp_path_factory.mktemp("hugs"))["train"]


@pytest.mark.slow
def test_a_posed_person_in_arrays(train):
    pose = np.random.default_rng(0).normal(0, 0.3, 69)
    person = hugs.load_avatar(train / "avatar.npz").pose(pose, [0, 0.5, 0], transl=(1, 2, 3))
    tensors = (torch.as_tensor(part, dtype=torch.float32) for part in ([0, 0.5, 0], pose, [1, 2, 3]))
    truth = pose_avatar(load_avatar(read_avatar(train / "avatar.npz")), *tensors)
    np.testing.assert_allclose(person.means, truth.means, atol=1e-6)
    axes = matrix_from_quat(torch.as_tensor(person.quats)) * torch.as_tensor(person.scales)[:, None]
    torch.testing.assert_close(axes @ axes.mT, truth.axes @ truth.axes.mT, atol=1e-7, rtol=1e-4)
    np.testing.assert_array_equal(person.opacities, truth.opacities)
    np.testing.assert_allclose(person.colors, truth.colors(torch.zeros(3)), atol=1e-6)
    assert person.sh.shape == (len(person.means), 1, 3)
    assert {part.dtype for part in (person.means, person.quats, person.scales, person.colors)} == {np.dtype("f4")}


def test_a_person_before_a_scene(train, tmp_path):
    avatar, scene = hugs.load_avatar(train / "avatar.npz"), hugs.load_scene(train / "scene.npz")
    assert avatar.joints.shape == (24, 3) and len(hugs.JOINT_NAMES) == 24
    view = hugs.camera((0, 0, 0), (0, 0, 3), up=(0, -1, 0), focal=100, width=96, height=128)
    person = avatar.pose(global_orient=(np.pi, 0, 0), transl=(0, 0, 3))
    image, coverage = hugs.draw(person, view, scene)
    seen = tiny.colour_of(np.rint(image * 255))
    assert (seen >= 0).sum() > 300 and coverage.min() > 0.8 and image.shape == (128, 96, 3)
    empty, _ = hugs.draw(None, view, scene)
    assert (tiny.colour_of(np.rint(empty * 255)) >= 0).sum() == 0
    hugs.write_image(str(tmp_path / "a.png"), image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), np.rint(np.clip(image, 0, 1) * 255))


@pytest.mark.parametrize(
    "given", [{"body_pose": np.zeros(72)}, {"transl": [0, np.nan, 0]}, {"global_orient": np.eye(3)}]
)
def test_what_is_no_pose_is_refused_by_name(train, given):
    with pytest.raises(ValueError, match=next(iter(given))):
        hugs.load_avatar(train / "avatar.npz").pose(**given)


def test_what_is_no_avatar_is_refused_by_name(train):
    with pytest.raises(StageError, match=r"scene\.npz"):
        hugs.load_avatar(train / "scene.npz")

"""The measures must give zero for the truth itself, moved as SfM may move it, and the known amount for a known error."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.cameras.pinhole import project
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.poses import read_poses
from stages.synthetic.clip import make_clip
from stages.synthetic.files import write_clip
from tests.made.truth import align, camera_errors, in_result_world, joint_errors, joints_of, mask_ious
from tests.made.worlds import align_viewmats

SCALE, R, T = 0.37, Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix(), np.array([1.0, -2.0, 0.3])


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    write_clip(folder, make_clip(read_body_model(), width=60, height=80, frames=8, fps=4))
    return folder / "truth"


@pytest.fixture(scope="module")
def moved(truth):
    """The true cameras as SfM could give them: every world is as good, and three frames were lost."""
    cameras = read_cameras(truth / "cameras.npz")
    viewmats = align_viewmats(cameras.viewmats, SCALE, R, T)[2:-1]
    return replace(cameras, names=cameras.names[2:-1], viewmats=viewmats, Ks=cameras.Ks[2:-1])


def test_moved_cameras_have_no_error_and_a_shifted_one_has_its_own(truth, moved):
    cameras = read_cameras(truth / "cameras.npz")
    errors = camera_errors(moved, cameras, frames=8)
    assert errors.registered == 5 / 8
    assert max(errors.centre, errors.worst, errors.turn_degrees, errors.focal) < 1e-6
    assert errors.extent > 0.5
    shifted = moved.viewmats.copy()
    shifted[3, :3, 3] += [0.1 * SCALE, 0, 0]
    assert 0.02 < camera_errors(replace(moved, viewmats=shifted), cameras, 8).worst < 0.1


def test_the_truth_told_in_the_result_world_looks_the_same(truth, moved):
    """Novel cameras and poses moved into the result's world project every joint to the true pixel."""
    model, fitted = read_body_model(), read_poses(truth / "body.npz")
    world_from_sfm = 1 / SCALE
    similarity = align(moved, read_cameras(truth / "cameras.npz"), world_from_sfm)
    assert similarity.scale == pytest.approx(1)
    cameras, poses = in_result_world(truth / "novel", similarity, fitted, model, model)
    true_cameras, true_poses = read_cameras(truth / "novel" / "cameras.npz"), read_poses(truth / "novel" / "body.npz")
    found, _ = project(joints_of(poses, model), cameras.viewmats, cameras.Ks)
    wanted, _ = project(joints_of(true_poses, model), true_cameras.viewmats, true_cameras.Ks)
    assert np.abs(found - wanted).max() < 1e-6


def test_a_body_10_cm_off_has_10_cm_of_error_in_the_world_and_none_about_its_pelvis(truth, moved):
    model, poses = read_body_model(), read_poses(truth / "body.npz")
    cameras = read_cameras(truth / "cameras.npz")
    off = replace(poses, transl=poses.transl + [0.06, 0, 0.08])
    world, about = joint_errors(off, poses, align(cameras, cameras), model, model)
    assert (world, about) == (pytest.approx(0.1), pytest.approx(0, abs=1e-9))


def test_a_mask_overlaps_itself_wholly(truth):
    assert (mask_ious(truth / "masks", truth / "masks") == 1).all()

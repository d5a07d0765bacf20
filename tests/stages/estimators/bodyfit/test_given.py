"""Files of tools whose body rests as SMPL does, imported onto the free body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.avatar.body.smpl_rest import smpl_rest
from stages.avatar.cameras.pinhole import rescale_viewmats
from stages.estimators.bodyfit.given import import_fit
from stages.estimators.bodyfit.resting import posed_joints
from stages.formats.body_model import read_body_model
from stages.formats.given_fits.recognize import read_smpl_fit
from stages.formats.given_fits.record import SMPLX_PELVIS
from tests.made import fits
from tests.made.said import holds
from tests.made.smplx import made_smplx
from tests.made.truth import joints_of

LIMBS = [4, 5, 7, 8, 16, 17, 18, 19, 20, 21]


@pytest.fixture(scope="module")
def truth():
    """The clip as tools see it whose body rests as SMPL does."""
    return replace(fits.make_truth(), rest=smpl_rest()[0])


def seen_and_true(poses, model, truth):
    """Joints [N,24,3] m in the cameras: those of the fitted body, and those of the tool's, which rests as SMPL does."""
    local, _ = posed_joints(smpl_rest(), truth.orient, truth.views.body_pose)
    local = local - local[:, :1] + truth.pelvis[:, None]
    views = rescale_viewmats(truth.viewmats, poses.world_from_sfm)
    return np.einsum("fij,fkj->fki", views[:, :3, :3], joints_of(poses, model)) + views[:, None, :3, 3], local


@pytest.mark.slow
@pytest.mark.parametrize("tool", fits.FILES)
def test_pelvis_and_limbs_are_where_the_tool_sees_them(tool, truth, tmp_path):
    fit = read_smpl_fit(fits.write(tool, fits.contents(tool, truth), tmp_path), truth.size)
    poses, _ = import_fit(fit, fits.inputs_of(truth, read_body_model()))
    seen, local = seen_and_true(poses, read_body_model(), truth)
    middle = [joints[:, 1:3].mean(1, keepdims=True) for joints in (seen, local)]
    limbs = np.linalg.norm(seen - middle[0] - local + middle[1], axis=-1)[:, LIMBS]
    assert np.linalg.norm(middle[0] - middle[1], axis=-1).max() < 0.01 and limbs.mean() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("tool, kept", [("AMASS", False), ("AMASS SMPL-X", True)])
def test_on_a_users_smplx_the_poses_of_smplx_are_kept_and_those_of_smpl_carried_over(tool, kept, truth, tmp_path):
    """Its pelvis rests elsewhere than SMPL's: kept as they are, poses of SMPL would be 13 cm off."""
    np.savez(tmp_path / "SMPLX_NEUTRAL.npz", **made_smplx(pelvis=SMPLX_PELVIS))
    model = read_body_model(tmp_path / "SMPLX_NEUTRAL.npz")
    fit = read_smpl_fit(fits.write(tool, fits.contents(tool, truth), tmp_path), truth.size)
    poses, facts = import_fit(fit, fits.inputs_of(truth, model))
    at = [joints[:, :1] if kept else joints[:, 1:3] for joints in seen_and_true(poses, model, truth)]
    assert np.linalg.norm(at[0].mean(1) - at[1].mean(1), axis=-1).max() < 0.01
    assert np.allclose(poses.body_pose, fit.body_pose, atol=1e-6) == kept
    assert any(holds(note, "SMPL's", "carried over") for note in facts["notes"]) != kept

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
from tests.made import fits
from tests.made.truth import joints_of

LIMBS = [4, 5, 7, 8, 16, 17, 18, 19, 20, 21]


@pytest.fixture(scope="module")
def truth():
    """The clip as tools see it whose body rests as SMPL does."""
    return replace(fits.make_truth(), rest=smpl_rest()[0])


@pytest.mark.slow
@pytest.mark.parametrize("tool", fits.FILES)
def test_pelvis_and_limbs_are_where_the_tool_sees_them(tool, truth, tmp_path):
    fit = read_smpl_fit(fits.write(tool, fits.contents(tool, truth), tmp_path), truth.size)
    poses, _ = import_fit(fit, fits.inputs_of(truth, read_body_model()))
    local, _ = posed_joints(smpl_rest(), truth.orient, truth.views.body_pose)
    local = local - local[:, :1] + truth.pelvis[:, None]
    ours = joints_of(poses, read_body_model())
    views = rescale_viewmats(truth.viewmats, poses.world_from_sfm)
    seen = np.einsum("fij,fkj->fki", views[:, :3, :3], ours) + views[:, None, :3, 3]
    hips = np.linalg.norm((seen[:, 1] + seen[:, 2] - local[:, 1] - local[:, 2]) / 2, axis=-1)
    middle = [joints[:, 1:3].mean(1, keepdims=True) for joints in (seen, local)]
    limbs = np.linalg.norm(seen - middle[0] - local + middle[1], axis=-1)[:, LIMBS]
    assert hips.max() < 0.01 and limbs.mean() < 0.02

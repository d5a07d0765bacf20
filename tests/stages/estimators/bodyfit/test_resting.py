"""Poses of SMPL carried over to the free body, which rests otherwise."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl_rest import smpl_rest
from stages.estimators.bodyfit.resting import carry_over, nearest_shape, onto_body, posed_joints
from stages.formats.body_model import read_body_model
from stages.formats.given_fits.record import SMPLX_PELVIS, SmplFit

MODEL = read_body_model()
REGRESSOR = MODEL.J_regressor.astype(float)
SPINE, LIMBS = [3, 6, 9, 13, 14], [4, 5, 7, 8, 16, 17, 18, 19, 20, 21]


def moves(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Turns of a body that bends its spine a little and its limbs much."""
    rng = np.random.default_rng(0)
    much = np.where(np.isin(np.arange(1, 24), SPINE), 0.08, 0.4)[:, None]
    return rng.normal(size=(count, 3)), (rng.normal(size=(count, 23, 3)) * much).reshape(count, 69)


def joints_of(betas: np.ndarray) -> np.ndarray:
    return REGRESSOR @ (MODEL.v_template + MODEL.shapedirs @ betas)


def test_a_body_that_rests_as_smpl_keeps_its_poses():
    orient, pose = moves(5)
    same = carry_over(orient, pose, smpl_rest(), smpl_rest())
    for a, b in zip(same[:2], (orient, pose), strict=True):
        turns = Rotation.from_rotvec(a.reshape(-1, 3)).inv() * Rotation.from_rotvec(b.reshape(-1, 3))
        assert turns.magnitude().max() < 1e-6
    assert abs(same[2]).max() < 1e-9


@pytest.mark.parametrize("tool", ["WHAM", "world", "GVHMR"])
def test_the_limbs_of_the_free_body_are_where_smpls_are(tool):
    orient, pose = moves()
    place = np.random.default_rng(1).normal(size=(len(orient), 3)) + [0, 0, 4]
    scale = np.full(len(orient), 0.4) if tool == "world" else None
    pelvis = SMPLX_PELVIS if tool == "GVHMR" else None  # it turns about SMPL-X's
    given = SmplFit("a", tool, np.zeros((len(orient), 10)), orient, pose, place, scale=scale, pelvis=pelvis)
    fit = onto_body(given, MODEL)
    size = 1.0 if scale is None else scale[:, None, None]
    origin = smpl_rest()[0] if pelvis is None else pelvis
    wanted = size * (posed_joints(smpl_rest(), orient, pose)[0] - smpl_rest()[0] + origin) + place[:, None]
    ours, _ = posed_joints(joints_of(fit.betas[0]), fit.global_orient, fit.body_pose)
    root = fit.pelvis + Rotation.from_rotvec(fit.global_orient).apply(fit.offset)
    ours = size * (ours - ours[:, :1] + root[:, None]) + fit.transl[:, None]
    off = np.linalg.norm(ours - wanted, axis=-1) / np.min(size)
    naive, _ = posed_joints(joints_of(np.zeros(10)), orient, pose)
    before = np.linalg.norm(size * (naive - naive[:, :1] + origin) + place[:, None] - wanted, axis=-1)
    assert off[:, LIMBS].mean() < 0.02 and off[:, LIMBS].mean() < 0.5 * before[:, LIMBS].mean() / np.min(size)
    assert np.linalg.norm((ours[:, 1] + ours[:, 2] - wanted[:, 1] - wanted[:, 2]) / 2, axis=-1).max() < 1e-6


def test_limbs_and_trunk_get_as_long_as_asked():
    rest, change = joints_of(np.zeros(10)), np.einsum("jv,vcb->jcb", REGRESSOR, MODEL.shapedirs)
    betas = np.array([0.8, -0.5, *[0.0] * 8])
    found = nearest_shape(rest, change, rest + change @ betas)
    legs = [np.linalg.norm((rest + change @ b)[[4, 7]] - (rest + change @ b)[[1, 4]], axis=1) for b in (found, betas)]
    assert np.allclose(*legs, atol=2e-3)


def test_smpl_at_rest_stands_upright_with_arms_to_the_sides():
    rest = smpl_rest()
    assert rest[15, 1] - rest[10, 1] == pytest.approx(1.5, abs=0.02) and np.ptp(rest[:, 0]) == pytest.approx(
        1.53, abs=0.02
    )

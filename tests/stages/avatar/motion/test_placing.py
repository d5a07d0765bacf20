"""Which way is up, facing ahead, and feet on a level floor."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.avatar.body.joints import HIPS
from stages.avatar.motion import placing
from stages.avatar.motion.formulas import MOTIONS
from stages.avatar.motion.retarget import Performance, from_smpl, leg_of
from stages.formats.body_model import read_body_model

FPS = 50
TO_FILE = {"y": [0, 0, 0], "-y": [np.pi, 0, 0], "z": [np.pi / 2, 0, 0], "-z": [-np.pi / 2, 0, 0]}


@pytest.fixture(scope="module")
def soles():
    return placing.Soles.of_model(read_body_model(), np.linspace(-1, 1, 10))


def performance(soles, name="jumping_jacks", turned=(0, 0, 0)):
    """A formula motion as an SMPL file holds it whose world is turned by `turned`."""
    orient, pose, transl = (t.numpy().astype(float) for t in MOTIONS[name](2.4, FPS))
    turn = Rotation.from_rotvec(turned)
    orient = (turn * Rotation.from_rotvec(orient)).as_rotvec()
    pelvis = soles.joints[0]
    rotvecs = np.concatenate([orient, pose], 1).reshape(-1, 24, 3)
    return from_smpl(rotvecs, turn.apply(transl + pelvis) - pelvis, soles.joints)


@pytest.mark.parametrize("up", placing.UPS)
@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_any_axis_may_be_up(soles, up, yaw):
    straight = performance(soles)
    turn = Rotation.from_rotvec(TO_FILE[up]) * Rotation.from_rotvec([0, yaw, 0])
    turned = performance(soles, turned=turn.as_rotvec())
    assert placing.which_is_up(turned) == up
    a, b = (placing.face_ahead(motion, way) for motion, way in ((straight, "y"), (turned, up)))
    np.testing.assert_allclose(a.rotations, b.rotations, atol=1e-6)
    np.testing.assert_allclose(a.hips - a.hips[0], b.hips - b.hips[0], atol=1e-6)
    np.testing.assert_allclose(b.hips[0, [0, 2]], 0, atol=1e-12)
    assert a.rotations[0, 0, 2, 2] > 0.999


def test_nobody_knows_which_way_is_up_for_someone_lying_on_the_side(soles):
    assert placing.which_is_up(performance(soles, turned=[0, 0, np.pi / 2])) is None
    lying = placing.face_ahead(performance(soles, turned=[0, 0, np.pi / 2]), "y")
    assert np.isfinite(lying.rotations).all() and lying.rotations[0, 0, 2, 2] > 0.999


def heights(soles, placed):
    points, _ = soles.at(placed.global_orient, placed.body_pose, placed.transl)
    return points[..., 1].min(1)


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("drift", [0.0, 0.3])
def test_soles_are_on_the_floor_or_over_it(soles, name, drift):
    """A capture that slowly floats away stands still here; a jump stays a jump."""
    motion = performance(soles, name)
    floating = motion.hips + np.linspace(0, drift, len(motion.hips))[:, None] * [0, 1, 0] + [0, 7.0, 0]
    placed = placing.on_floor(motion._replace(hips=floating), FPS, soles)
    low = heights(soles, placed)
    assert low.min() > -1e-9 and low[0] < 0.015
    known = low[: -int(placing.FLIGHT * FPS)]  # whoever rises at the end may be about to jump
    assert 0.04 < known.max() < 0.15 if name == "jumping_jacks" else known.max() < 0.015
    assert placed.drift == pytest.approx(drift, abs=0.06)
    assert np.abs(np.diff(placed.transl[:, 1])).max() < 0.025, "no jolts"


def test_steps_are_as_long_as_the_legs(soles):
    motion = performance(soles, "walk_in_place")
    far = motion.hips + np.linspace(0, 2, len(motion.hips))[:, None] * [1, 0, 0]
    small = Performance(motion.rotations, far * 20, motion.leg * 20)  # the same in inches, or of a giant
    placed = [placing.on_floor(one, FPS, soles) for one in (motion._replace(hips=far), small)]
    np.testing.assert_allclose(placed[0].transl, placed[1].transl, atol=1e-9)
    _, joints = soles.at(*placed[0][:3])
    middle = joints[:, HIPS].mean(1)
    assert np.ptp(middle[:, 0]) == pytest.approx(np.ptp(far[:, 0]) * leg_of(soles.joints) / motion.leg, rel=1e-6)

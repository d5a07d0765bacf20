"""How large a metre is: by bodies, by heights, by a length in the scene, and what disagrees."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import look_at, project, rescale_viewmats
from stages.contract import StageError
from stages.estimators.bodyfit.metre import BY_BODY, BY_HEIGHT, find_metre, resized, stature_of
from stages.estimators.bodyfit.reporting import sureness
from stages.formats.body_model import read_body_model
from stages.records import BodyPoses
from tests.made.said import any_holds, holds

MODEL = read_body_model()


def test_without_a_length_nothing_grows_and_the_doubt_is_said():
    metre = find_metre([1.74], 0.37, True, {}, None)
    assert metre.factors == (1.0,) and metre.error == BY_BODY and not metre.given
    said = sureness(metre, 1.74)
    assert holds(
        said, f"{100 * BY_BODY:.0f} %", f"{1.74 / (1 + BY_BODY):.2f}", f"{1.74 * (1 + BY_BODY):.2f}", "--height"
    )


@pytest.mark.parametrize("tall", [1.1, 1.85, 2.1])
def test_a_given_height_sets_the_metre(tall):
    metre = find_metre([1.74], 0.37, True, {1: tall}, None)
    assert metre.factors == (pytest.approx(tall / 1.74),) and metre.error == BY_HEIGHT and not metre.doubts
    assert holds(sureness(metre, 1.74), f"{tall:.2f} m of person 1", "1.74 m")


def test_two_heights_share_a_metre_and_their_disagreement_is_said_with_both():
    metre = find_metre([1.74, 1.60], 0.5, True, {1: 1.80, 2: 1.65}, None)
    assert (
        metre.factors[0] == metre.factors[1] == pytest.approx(np.sqrt(1.80 / 1.74 * 1.65 / 1.60)) and not metre.doubts
    )
    metre = find_metre([1.74, 1.60], 0.5, True, {1: 1.80, 2: 1.45}, None)
    assert any_holds(
        metre.doubts, "14 %", f"{0.5 * 1.80 / 1.74:.4g} m by person 1", f"{0.5 * 1.45 / 1.60:.4g} m by person 2"
    )
    alone = find_metre([1.74, 1.60], 0.5, True, {2: 1.45}, None)
    assert alone.factors == (pytest.approx(1.45 / 1.60),) * 2, "who is not known is as large as the other makes them"


def test_before_a_camera_that_stands_each_has_their_own_size():
    metre = find_metre([1.74, 1.70, 1.70], 1.0, False, {1: 1.85, 2: 1.20}, None)
    assert metre.factors[:2] == (pytest.approx(1.85 / 1.74), pytest.approx(1.20 / 1.70)) and not metre.doubts


def test_a_length_in_the_scene_and_cameras_in_metres_win_over_heights_and_that_is_said():
    metre = find_metre([1.74], 0.37, True, {1: 1.76}, (2.31, 2.00))
    assert metre.factors == (pytest.approx(2.00 / 2.31),)
    assert any_holds(metre.doubts, "person 1", "1.76 m", "17 %", f"{1.74 * 2 / 2.31:.2f} m")
    metre = find_metre([1.74], 0.37, True, {}, "cameras")
    assert metre.factors == (pytest.approx(1 / 0.37),) and not metre.doubts
    with pytest.raises(StageError, match="do not move") as error:
        find_metre([1.74], 1.0, False, {}, "cameras")
    assert "--height" in error.value.hint


def test_a_height_of_nobody_is_refused():
    with pytest.raises(StageError, match=r"person 2.*one person") as error:
        find_metre([1.74], 0.37, True, {2: 1.70}, None)
    assert "--person all" in error.value.hint


@pytest.mark.parametrize("factor", [0.6, 1.08])
def test_a_body_of_another_size_is_seen_the_same(factor):
    rng = np.random.default_rng(0)
    names, K = ("a", "b", "c"), np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    eyes = np.array([2.0, 1.0, -3.0]) + rng.normal(0, 0.3, (3, 3))
    views = np.stack([look_at(eye, np.zeros(3), np.array([0, 1.0, 0])) for eye in eyes])
    turns, pose = 0.3 * rng.standard_normal((3, 3)), 0.2 * rng.standard_normal((3, 69))
    poses = BodyPoses(names, rng.standard_normal(10), turns, pose, 0.2 * rng.standard_normal((3, 3)), np.ones(3), 0.5)
    views[:, :3, 3] /= poses.world_from_sfm

    def seen(model, poses):
        parts = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
        joints = Body(model, torch.float64)(*(torch.as_tensor(part) for part in parts))[1].numpy()
        return project(joints, rescale_viewmats(views, poses.world_from_sfm), np.tile(K, (3, 1, 1)))[0]

    model, grown = resized(MODEL, poses, factor, factor * 0.5, eyes.mean(0) / 0.5)
    assert stature_of(model, grown) == pytest.approx(factor * stature_of(MODEL, poses), rel=1e-6)
    np.testing.assert_allclose(seen(model, grown), seen(MODEL, poses), atol=1e-3)
    views = np.repeat(views[:1], 3, 0)  # a camera that stands: body and world grow each by their own
    center = -views[0, :3, :3].T @ views[0, :3, 3]
    model, grown = resized(MODEL, poses, factor, 0.7, center)
    np.testing.assert_allclose(seen(model, grown), seen(MODEL, poses), atol=1e-3)

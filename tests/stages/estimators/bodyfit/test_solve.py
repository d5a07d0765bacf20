"""What all frames of a clip share in the body fit: clothes, and the bias of the landmarks' depths."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit import solve
from stages.estimators.bodyfit.evidence import drop_strangers, gather, model_landmarks, vote_sides
from stages.estimators.bodyfit.fit import fit_body
from stages.estimators.bodyfit.solve import sight_turns
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES
from tests.made import bodyfit_clips

MODEL = read_body_model()
PELVIS, NECK = JOINT_NAMES.index("pelvis"), JOINT_NAMES.index("neck")


def test_the_line_of_sight_turns_sideways_only():
    K = torch.tensor([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]]).expand(3, 3, 3)
    turns = sight_turns(torch.tensor([[320.0, 10], [820.0, 180], [-180.0, 300]]), K)
    ahead = turns @ torch.tensor([0, 0, 1.0])
    s = 0.5**0.5
    torch.testing.assert_close(ahead, torch.tensor([[0, 0, 1.0], [s, 0, s], [-s, 0, s]]))


def fit_error(clip, tracks, masks) -> tuple[float, float]:
    """Mean joint error in m, and how many degrees the trunk leans toward the camera more than it does."""
    names, regressor = model_landmarks(MODEL)
    evidence = vote_sides(drop_strangers(gather(tracks, names), None)[0])[0]
    poses = fit_body(MODEL, regressor, evidence, clip.cameras, clip.times, masks, clip.points).poses
    parts = (
        torch.tensor(part, dtype=torch.float32)
        for part in (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
    )
    joints = Body(MODEL)(*parts)[1].numpy() * clip.scale / poses.world_from_sfm
    up = clip.joints[:, 15].mean(0) - clip.joints[:, [7, 8]].mean((0, 1))
    up /= np.linalg.norm(up)
    view = clip.joints[:, 0] - clip.cameras.centers * clip.scale
    view -= (view @ up)[:, None] * up
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    leans = [
        np.degrees(np.arctan2(-(trunk * view).sum(1), trunk @ up))
        for trunk in (x[:, NECK] - x[:, PELVIS] for x in (joints, clip.joints))
    ]
    return float(np.linalg.norm(joints - clip.joints, axis=-1).mean()), float((leans[0] - leans[1]).mean())


@pytest.mark.slow
def test_wide_clothes_do_not_make_the_body_lean_or_come_nearer(monkeypatch):
    clip = bodyfit_clips.make(MODEL, frames=24)
    wide = [cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (17, 17))) for mask in clip.masks()]  # 3.4 cm
    error, _ = fit_error(clip, clip.tracks, wide)
    assert error < 0.06, "0.024 with the body's own outline"
    monkeypatch.setattr(solve, "CLOTH", (0.0, 1e-4))
    assert fit_error(clip, clip.tracks, wide)[0] > 2 * error, "0.15 without room for clothes"


@pytest.mark.slow
def test_landmarks_that_all_lean_are_set_upright_by_balance():
    clip = bodyfit_clips.make(MODEL, frames=24)
    leaning = [
        track and replace(track, world=track.world + 0.2 * track.world[:, [1]] * [0, 0, -1]) for track in clip.tracks
    ]
    _, lean = fit_error(clip, leaning, clip.masks())
    assert abs(lean) < 0.5 * np.degrees(np.arctan(0.2)), "of 11 degrees"

"""What the body fit takes from the world and the clip: balance, clothes, the bias of the landmarks' depths."""

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
from stages.estimators.bodyfit.solve import Solver, State, World, sight_turns
from stages.estimators.bodyfit.terms import mass_shares, smooth_acceleration
from stages.formats.body_model import read_body_model
from stages.records import JOINT_NAMES
from tests.made import bodyfit_clips

MODEL = read_body_model()
PELVIS, NECK = JOINT_NAMES.index("pelvis"), JOINT_NAMES.index("neck")


def standing(frames: int = 12, lean: float = 0.0) -> tuple[Solver, State]:
    """A solver whose only evidence is its world, y up, and somebody in it who stands upright, leaning ahead by `lean` rad."""
    names, regressor = model_landmarks(MODEL)
    clip = bodyfit_clips.make(MODEL, frames=frames)
    evidence = gather(clip.tracks, names)
    eye, still = torch.eye(3).expand(frames, 3, 3), torch.zeros(frames, 3)
    world = World(eye, still, torch.arange(frames) / 12, False, torch.tensor([0.0, 1, 0]), 0.0, 0.0)
    solver = Solver(Body(MODEL), torch.tensor(regressor), torch.tensor(MODEL.faces.astype(np.int64)), evidence,
                    clip.cameras.Ks, world)  # fmt: skip
    turn = torch.tensor([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]]).float()
    return solver, State(
        turn.expand(frames, 3, 3), still + torch.tensor([0, 0.9, 3.0]), torch.zeros(frames, 69), torch.zeros(10)
    )


def move_trunk(joints: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Joints [F,24,3] with all but ankles and feet moved; the mass then moves by 0.97 of it."""
    still = torch.tensor([any(part in name for part in ("ankle", "foot")) for name in JOINT_NAMES])
    return joints + torch.where(still[:, None], torch.zeros(3), by)


def balance(lean: float, stands: float = 1.0) -> float:
    solver, state = standing(lean=lean)
    return float(solver.balance_cost(state, solver.pose(state)[1], torch.full((12, 2), stands), torch.tensor(1.0)))


def test_mass_over_the_feet_costs_little_and_leaning_costs_more_the_more_one_leans():
    upright, little, much = (balance(lean) for lean in (0.0, 0.1, 0.3))
    assert upright < 1 and upright < little < much
    assert balance(0.3, stands=0.0) == 0, "who does not stand may lean"


def test_mass_may_stand_anywhere_between_two_feet_but_not_beside_one():
    solver, state = standing()
    shifted = move_trunk(solver.pose(state)[1], torch.tensor([0.08, 0, 0]))
    both, left, right = (
        float(solver.balance_cost(state, shifted, torch.tensor([on]).repeat(12, 1), torch.tensor(1.0)))
        for on in ([1.0, 1.0], [1.0, 0.0], [0.0, 1.0])
    )
    assert both < 0.5 < min(left, right) and left < right, "+x is the left side"


def test_who_speeds_up_leans_ahead_of_the_feet():
    solver, state = standing()
    times = solver.world.times
    ahead = torch.stack([0 * times, 0 * times, 0.5 * 2.0 * times**2], 1)[:, None]  # 2 m/s^2
    lean = 0.9 * 2.0 / solve.GRAVITY
    costs = [
        float(solver.balance_cost(state, move_trunk(solver.pose(state)[1] + ahead, torch.tensor([0, 0, z])),
                                  torch.ones(12, 2), torch.tensor(1.0)))
        for z in (0.0, lean, 2 * lean)
    ]  # fmt: skip
    assert costs[1] < costs[0] and costs[1] < costs[2]


def test_the_center_of_mass_lies_where_people_have_it():
    shares = mass_shares()
    assert float(shares.sum()) == pytest.approx(1) and (shares >= 0).all()
    vertices, joints = Body(MODEL).rest(torch.zeros(10))
    height = (joints[:, 1] * shares).sum() - vertices[:, 1].min()
    assert 0.53 < float(height) / float(np.ptp(MODEL.v_template[:, 1])) < 0.62


def test_acceleration_of_a_parabola_is_exact_and_of_a_few_points_is_none():
    times = torch.tensor([0.0, 0.1, 0.15, 0.3, 0.4, 0.5, 0.6])
    path = torch.stack([2 * times**2, 3 - times, 0 * times], 1)
    torch.testing.assert_close(smooth_acceleration(path, times, 0.7)[:, 0], torch.full((7,), 4.0), atol=1e-3, rtol=0)
    assert (smooth_acceleration(path, times, 0.1) == 0).all()
    assert (smooth_acceleration(path[:1], times[:1], 0.5) == 0).all()


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

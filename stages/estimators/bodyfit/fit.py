"""Fits an SMPL-format body to one person's landmarks and masks through a clip: one shape, one scale, steady in the world."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from stages.avatar.body.rotations import matrix_from_rotvec, rotvec_from_matrix
from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit import scale as scales
from stages.estimators.bodyfit import terms
from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.estimators.bodyfit.solve import Solver, State, World
from stages.estimators.bodyfit.start import fill_limbs, fill_poses, place, start_pose, unwrap_rotations
from stages.records import BodyModel, BodyPoses, Cameras

FIRST, OUTLINED, LAST = 120, 100, 300  # steps on landmarks, then outlines too, then feet and scale as well


@dataclass
class BodyFit:
    """The fitted poses, the 2D landmarks [F,K,2] px they project to, and how the scale was found."""

    poses: BodyPoses
    pixels: np.ndarray
    scale: dict[str, Any] = field(default_factory=dict)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread.

    Frames share vertices, and torch adds their gradients up in whatever order its threads come by: two runs on two threads
    differed by up to 0.1 rad. On one thread they are bit for bit the same, and no slower: 21 s, on two 22 to 24 s (40 frames).
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


@one_thread()
def fit_body(
    model: BodyModel,
    regressor: np.ndarray,
    evidence: LandmarkEvidence,
    cameras: Cameras,
    times: np.ndarray,
    masks: list[np.ndarray] | None = None,
    points: np.ndarray | None = None,
    moving: bool = True,
    progress: Callable[[int, int, float], None] = lambda done, total, cost: None,
) -> BodyFit:
    """Fit `model` to `evidence` (whose landmarks are `regressor` [K,V] @ vertices) seen by `cameras` (SfM units).

    `times` [F] s; `masks` F of uint8 [H,W]; `points` [P,3] SfM units for the floor; `moving` False: one fixed camera,
    whose metric frame is the world. Frames not seen are filled in between and get confidence 0. Needs one seen frame.
    """
    seen = np.flatnonzero(evidence.seen)
    body = Body(model)
    joints = body.rest(torch.zeros(10))[1].numpy().astype(np.float64)
    solver = _make_solver(body, model, regressor, evidence, cameras, times, moving, seen)
    root, local = start_pose(solver.evidence, joints)
    local = fill_limbs(rotvec_from_matrix(torch.tensor(local)).numpy(), solver.evidence, times[seen])
    pose = torch.tensor(unwrap_rotations(local), dtype=torch.float32)
    state = State(torch.tensor(root, dtype=torch.float32), torch.zeros(len(seen), 3), pose.flatten(1), torch.zeros(10))
    start, _ = solver.posed(state)
    shift = place(start.numpy().astype(np.float64), solver.evidence.xy, solver.evidence.weight, cameras.Ks[seen])
    state.place = torch.tensor(shift, dtype=torch.float32)
    total, borders, near = FIRST + OUTLINED + LAST, None, None
    if masks is not None:
        borders, near = terms.outlines(masks), terms.outlines([masks[i] for i in seen])
    state = solver.minimise(state, FIRST, None, False, lambda i, cost: progress(i, total, cost))
    state = solver.minimise(state, OUTLINED, near, False, lambda i, cost: progress(FIRST + i, total, cost))

    found, floor = _find_scale(solver, state, cameras, points, seen, moving)
    state.scale = found["initial"]
    solver, state = _all_frames(solver, state, body, model, regressor, evidence, cameras, times, seen, floor)
    state = solver.minimise(state, LAST, borders, True, lambda i, cost: progress(total - LAST + i, total, cost))
    with torch.no_grad():
        pixels = solver.pixels(solver.posed(state)[0]).numpy()
    found["world_from_sfm"] = state.scale
    return BodyFit(_poses(solver, state, cameras, evidence.seen.astype(np.float64)), pixels, found)


def _make_solver(body, model, regressor, evidence, cameras, times, moving, frames, floor=None) -> Solver:
    """The solver of some frames. Camera centres are taken about their mean, so that float32 keeps what differs."""
    part = LandmarkEvidence(
        evidence.names,
        *(getattr(evidence, key)[frames] for key in ("xy", "weight", "world", "seen", "height")),
    )
    middle = cameras.centers.mean(0)
    world = World(
        torch.tensor(cameras.viewmats[frames, :3, :3], dtype=torch.float32),
        torch.tensor(cameras.centers[frames] - middle, dtype=torch.float32),
        torch.tensor(times[frames] - times[0], dtype=torch.float32),
        moving,
        None if floor is None else torch.tensor(floor.normal, dtype=torch.float32),
        0.0 if floor is None else float(floor.height(middle)),
    )
    faces = torch.tensor(model.faces.astype(np.int64))
    return Solver(body, torch.tensor(regressor), faces, part, cameras.Ks[frames], world)


def _find_scale(solver, state, cameras, points, seen, moving):
    """Metres per SfM unit before the joint solve, how it was found, and the floor."""
    turn = solver.world.turn.double().numpy()
    with torch.no_grad():
        soles = solver.surface(state, solver.soles.flatten())[0]
        pixels = solver.pixels(soles).numpy()
        up = (turn.transpose(0, 2, 1) @ state.root.double().numpy())[:, :, 1].mean(0)
    soles = (soles.double().numpy() @ turn).reshape(len(seen), 2, -1, 3)
    times = solver.world.times.double().numpy()
    views = scales.TimedCameras(cameras.viewmats[seen], cameras.Ks[seen], cameras.centers[seen], times)
    return scales.find_scale(views if moving else None, points, soles, pixels, solver.evidence.height, up)


def _all_frames(solver, state, body, model, regressor, evidence, cameras, times, seen, floor):
    """Solver and state of all frames, from those of the seen ones; the others filled in between, in the world."""
    every = np.arange(len(times))
    whole = _make_solver(body, model, regressor, evidence, cameras, times, solver.world.moving, every, floor)
    if len(seen) == len(times):
        return whole, state
    spot = solver.to_world(state, state.place[:, None], state.scale)[:, 0]
    orient = rotvec_from_matrix(solver.world.turn.mT @ state.root)
    filled = fill_poses(*(np.asarray(a, np.float64) for a in (orient, spot, state.pose)), times[seen], times)
    orient, spot, pose = (torch.tensor(a, dtype=torch.float32) for a in filled)
    turn = whole.world.turn
    place = (turn @ (spot - state.scale * whole.world.center)[..., None])[..., 0]
    return whole, replace(state, root=turn @ matrix_from_rotvec(orient), place=place, pose=pose)


def _poses(solver: Solver, state: State, cameras: Cameras, confidence: np.ndarray) -> BodyPoses:
    """The state as SMPL parameters in the world: X = R^T X_camera + s C; the root turns about the rest pelvis J0."""
    turn = torch.tensor(cameras.viewmats[:, :3, :3])
    pelvis = solver.body.rest(state.betas)[1][0].double()
    spot = (turn.mT @ state.place.double()[..., None])[..., 0] + state.scale * torch.tensor(cameras.centers)
    return BodyPoses(
        names=cameras.names,
        betas=state.betas.double().numpy(),
        global_orient=rotvec_from_matrix(turn.mT @ state.root.double()).numpy(),
        body_pose=state.pose.double().numpy(),
        transl=(spot - pelvis).numpy(),
        confidence=confidence,
        world_from_sfm=state.scale,
    )

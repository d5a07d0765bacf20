"""Fits an SMPL-format body to one person's landmarks and masks through a clip: one shape, one scale, steady in the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from stages.avatar.body import Body
from stages.avatar.rotations import matrix_from_rotvec, rotvec_from_matrix
from stages.estimators import bodyfit_scale as scales
from stages.estimators import bodyfit_terms as terms
from stages.estimators.bodyfit_evidence import Evidence
from stages.estimators.bodyfit_solve import Solver, State, World
from stages.estimators.bodyfit_start import fill, place, start_pose
from stages.formats.body_model import BodyModel
from stages.formats.cameras import Cameras
from stages.formats.poses import BodyPoses

FIRST, SECOND = 120, 220  # steps on landmarks alone, then on everything


@dataclass
class BodyFit:
    """The fitted poses, the 2D landmarks [F,K,2] px they project to, and how the scale was found."""

    poses: BodyPoses
    pixels: np.ndarray
    scale: dict[str, Any] = field(default_factory=dict)


def fit_body(
    model: BodyModel,
    regressor: np.ndarray,
    evidence: Evidence,
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
    solver = _solver(body, model, regressor, evidence, cameras, times, moving, seen)
    root, local = start_pose(solver.evidence, joints)
    pose = torch.tensor(continuous(rotvec_from_matrix(torch.tensor(local)).numpy()), dtype=torch.float32)
    state = State(torch.tensor(root, dtype=torch.float32), torch.zeros(len(seen), 3), pose.flatten(1), torch.zeros(10))
    start, _ = solver.posed(state)
    shift = place(start.numpy().astype(np.float64), solver.evidence.xy, solver.evidence.weight, cameras.Ks[seen])
    state.place = torch.tensor(shift, dtype=torch.float32)
    total = FIRST + SECOND
    state = solver.minimise(state, FIRST, None, False, lambda i, cost: progress(i, total, cost))

    found, floor = _find_scale(solver, state, cameras, points, seen, moving)
    state.scale = found["initial"]
    solver, state = _all_frames(solver, state, body, model, regressor, evidence, cameras, times, seen, floor)
    borders = terms.outlines(masks) if masks is not None else None
    state = solver.minimise(state, SECOND, borders, True, lambda i, cost: progress(FIRST + i, total, cost))
    with torch.no_grad():
        pixels = solver.pixels(solver.posed(state)[0]).numpy()
    found["world_from_sfm"] = state.scale
    return BodyFit(_poses(solver, state, cameras, evidence.seen.astype(np.float64)), pixels, found)


def _solver(body, model, regressor, evidence, cameras, times, moving, frames, floor=None) -> Solver:
    """The solver of some frames. Camera centres are taken about their mean, so that float32 keeps what differs."""
    part = Evidence(
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
    if not moving:
        return {"initial": 1.0, "how": "one fixed camera: the world is its frame, in metres"}, None
    turn, centers = solver.world.turn.double().numpy(), cameras.centers[seen]
    with torch.no_grad():
        soles = solver.surface(state, solver.soles.flatten())[0]
        pixels = solver.pixels(soles).numpy()
        up = (turn.transpose(0, 2, 1) @ state.root.double().numpy())[:, :, 1].mean(0)
    soles = soles.double().numpy() @ turn
    found: dict[str, Any] = {}
    floor = None
    if points is not None and len(points):
        height = solver.evidence.height
        floor = scales.find_floor(points, cameras.viewmats[seen], cameras.Ks[seen], pixels, height, up)
    on_floor = scales.floor_scale(floor, soles, centers) if floor is not None else None
    feet = soles.reshape(len(seen), 2, -1, 3).mean(2)
    still = scales.still_scale(feet, centers, solver.world.times.double().numpy())
    if still is not None:
        found |= {"from_still_feet": still[0], "still_feet_error": still[1]}
    if on_floor is not None:
        found |= {"initial": on_floor[0], "floor_spread": on_floor[1], "floor_points": floor.points}
        return found | {"how": "the feet stand on the floor's SfM points"}, floor
    if still is not None:
        return found | {"initial": still[0], "how": "standing feet do not slide while the camera moves"}, None
    return found | {"initial": 1.0, "how": "not found: no floor and no standing foot"}, None


def _all_frames(solver, state, body, model, regressor, evidence, cameras, times, seen, floor):
    """Solver and state of all frames, from those of the seen ones; the others filled in between, in the world."""
    whole = _solver(body, model, regressor, evidence, cameras, times, solver.world.moving, np.arange(len(times)), floor)
    if len(seen) == len(times):
        return whole, state
    turn, all_turn = solver.world.turn, whole.world.turn
    place_world = solver.to_world(state, state.place[:, None], state.scale)[:, 0]
    root_world = continuous(rotvec_from_matrix(turn.mT @ state.root).numpy().reshape(-1, 1, 3)).reshape(-1, 3)
    filled = [fill(np.asarray(a, np.float64), times[seen], times) for a in (root_world, place_world, state.pose)]
    root, spot, pose = (torch.tensor(a, dtype=torch.float32) for a in filled)
    spot = (all_turn @ (spot - state.scale * whole.world.center)[..., None])[..., 0]
    return whole, replace(state, root=all_turn @ matrix_from_rotvec(root), place=spot, pose=pose)


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


def continuous(rotvecs: np.ndarray) -> np.ndarray:
    """The same rotations [F,J,3] with each vector taken a whole turn further where that is nearer to the frame before."""
    out = rotvecs.copy()
    for i in range(1, len(out)):
        angle = np.linalg.norm(out[i], axis=-1, keepdims=True)
        other = out[i] - np.where(angle > 1e-6, out[i] / np.maximum(angle, 1e-6) * 2 * np.pi, 0)
        nearer = np.linalg.norm(other - out[i - 1], axis=-1) < np.linalg.norm(out[i] - out[i - 1], axis=-1)
        out[i] = np.where(nearer[:, None], other, out[i])
    return out

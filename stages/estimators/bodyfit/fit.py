"""Fits an SMPL-format body to one person's landmarks and masks through a clip: one shape, one scale, steady in the world."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from stages.avatar.body.rotations import matrix_from_rotvec, rotvec_from_matrix
from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit import terms
from stages.estimators.bodyfit.balance import mass_and_soles
from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.estimators.bodyfit.expected_error import expected_errors
from stages.estimators.bodyfit.gravity import camera_up, trunk_up, up_on_slope
from stages.estimators.bodyfit.scale import TimedCameras, find_scale
from stages.estimators.bodyfit.snug import hidden_joints
from stages.estimators.bodyfit.solve import Solver, State, World
from stages.estimators.bodyfit.start import fill_limbs, fill_poses, solve_places, start_pose, unwrap_rotations
from stages.estimators.bodyfit.surface_motion import SurfaceMotion
from stages.estimators.ground import Plane
from stages.records import BodyModel, BodyPoses, Cameras

SOLE_SPREAD = 0.015  # m, that a sole may be thicker or thinner; the lower the camera, the more it leaves the scale open
SCALE_SHARE = 0.5  # of how far frames on the floor differ in their scale
FLOOR_TILT = 0.02  # rad, that a floor may lie off level
KNOWN, KNOWN_SPREAD = "that of the first person of the clip", 1e-4
FIRST, OUTLINED, LAST = 120, 100, 300  # steps on landmarks, then outlines too, then feet and scale as well


@dataclass
class BodyFit:
    """The fitted poses, the 2D landmarks [F,K,2] px they project to, and how the scale was found.

    `cloth_off`: how far cloth was off that frames far apart show, before it tied the poses and again later, as a share of the
    person's size in the picture; NaN where no cloth came again. `expected_error` [F,24,2] m: of `expected_errors`. `hidden`:
    joints inside wide clothes, of which outlines say nothing.
    """

    poses: BodyPoses
    pixels: np.ndarray
    scale: dict[str, Any] = field(default_factory=dict)
    cloth_off: list[float] = field(default_factory=list)
    expected_error: np.ndarray = field(default_factory=lambda: np.zeros((0, 24, 2)))
    hidden: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Inputs:
    """What is known of all frames before the fit; as `fit_body` takes it."""

    body: Body
    model: BodyModel
    regressor: np.ndarray
    evidence: LandmarkEvidence
    cameras: Cameras
    times: np.ndarray
    moving: bool
    motion: SurfaceMotion | None


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread.

    Joints, landmarks and frames are indexed more than once. On several threads torch adds the gradients of such an index in
    whatever order the threads come by, and two fits differed by up to 0.1 rad. One thread was not slower.
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
    images: Sequence[np.ndarray] | None = None,
    progress: Callable[[int, int, float], None] = lambda done, total, cost: None,
    metres: float | None = None,
) -> BodyFit:
    """Fit `model` to `evidence` (whose landmarks are `regressor` [K,V] @ vertices) seen by `cameras` (SfM units).

    `times` [F] s; `masks` F of uint8 [H,W]; `points` [P,3] SfM units for the floor; `moving` False: one fixed camera,
    whose metric frame is the world; `images` F of uint8 [H,W,3] beside masks: cloth that moves and comes again ties the
    poses together. `metres` per SfM unit are kept where they are known: by somebody else in the clip. Frames not seen are filled
    in between and get confidence 0. Needs one seen frame.
    """
    seen, motion = np.flatnonzero(evidence.seen), None
    if images is not None and masks is not None:
        motion = SurfaceMotion(images, masks, times, cameras.Ks, model.faces)
    inputs = _Inputs(Body(model), model, regressor, evidence, cameras, times, moving, motion)
    solver = _make_solver(inputs, seen)
    state = _begin(solver, times[seen], cameras.Ks[seen])
    total, borders, near = FIRST + OUTLINED + LAST, None, None
    if masks is not None:
        borders, near = terms.outlines(masks), terms.outlines([masks[i] for i in seen])
    state = solver.minimise(state, FIRST, None, False, lambda i, cost: progress(i, total, cost))
    if near is not None:
        solver.look_for_wide_clothes(state, near)
    state = solver.minimise(state, OUTLINED, near, False, lambda i, cost: progress(FIRST + i, total, cost))

    found, floor = _find_scale(solver, state, inputs, points, seen)
    if metres is not None:
        found = {"how": KNOWN, "initial": metres}
    state.scale = found["initial"]
    spread = 1.0 if metres is None else KNOWN_SPREAD
    slope = None
    if floor is not None:
        if metres is None:
            above = found["initial"] * np.median(floor.height(cameras.centers))
            spread = max(SOLE_SPREAD / above, SCALE_SHARE * found["floor_spread"])
        if (slope := _slope_of(solver, state, cameras.viewmats[seen], floor)) is not None:
            found["floor_slope_degrees"] = float(np.degrees(np.arccos(slope[0] @ floor.normal)))
    whole = _make_solver(inputs, np.arange(len(times)), floor, spread, slope)
    whole.snug = solver.snug
    solver, state = whole, _extend_to_all_frames(solver, whole, state, times, seen)
    state = solver.minimise(state, LAST, borders, True, lambda i, cost: progress(total - LAST + i, total, cost))
    with torch.no_grad():
        pixels = solver.pixels(solver.pose(state)[0]).numpy()
    found["world_from_sfm"] = state.scale
    poses = _body_poses(solver, state, cameras, evidence.seen.astype(np.float64))
    hidden = hidden_joints(solver.body, solver.dense.template, solver.snug)
    return BodyFit(poses, pixels, found, motion.cloth_off if motion else [], expected_errors(solver, state), hidden)


def _make_solver(
    inputs: _Inputs,
    rows: np.ndarray,
    floor: Plane | None = None,
    scale_spread: float = 1.0,
    slope: tuple[np.ndarray, float] | None = None,
) -> Solver:
    """The solver of the frames `rows`; `slope` is what is up, and how surely, where the floor is not level.

    Camera centres are taken about their mean, so that float32 keeps what differs.
    """
    evidence, cameras, times = inputs.evidence, inputs.cameras, inputs.times
    part = evidence.frames(rows)
    middle = cameras.centers.mean(0)
    up, up_spread = slope or (camera_up(cameras.viewmats) if floor is None else (floor.normal, FLOOR_TILT))
    world = World(
        torch.tensor(cameras.viewmats[rows, :3, :3], dtype=torch.float32),
        torch.tensor(cameras.centers[rows] - middle, dtype=torch.float32),
        torch.tensor(times[rows] - times[0], dtype=torch.float32),
        inputs.moving,
        torch.tensor(up, dtype=torch.float32),
        up_spread,
        torch.tensor([cameras.width, cameras.height]),
        inputs.motion,
        None if floor is None else (torch.tensor(floor.normal, dtype=torch.float32), float(floor.height(middle))),
        scale_spread,
    )
    faces = torch.tensor(inputs.model.faces.astype(np.int64))
    return Solver(inputs.body, torch.tensor(inputs.regressor), faces, part, cameras.Ks[rows], world)


def _begin(solver: Solver, times: np.ndarray, Ks: np.ndarray) -> State:
    """The first state, by landmarks alone: limbs along their directions, the body where its landmarks lie on theirs."""
    evidence, sight = solver.evidence, solver.sight.double().numpy()
    joints = solver.body.rest(torch.zeros(10))[1].numpy().astype(np.float64)
    root, local = start_pose(replace(evidence, world=evidence.world @ sight.transpose(0, 2, 1)), joints)
    local = fill_limbs(rotvec_from_matrix(torch.tensor(local)).numpy(), evidence, times)
    pose = torch.tensor(unwrap_rotations(local), dtype=torch.float32).flatten(1)
    state = State(torch.tensor(root, dtype=torch.float32), torch.zeros(len(times), 3), pose, torch.zeros(10))
    points = solver.pose(state)[0].numpy().astype(np.float64)
    shift = solve_places(points, evidence.xy, evidence.weight, Ks)
    return replace(state, place=torch.tensor(shift, dtype=torch.float32))


def _find_scale(
    solver: Solver, state: State, inputs: _Inputs, points: np.ndarray | None, seen: np.ndarray
) -> tuple[dict[str, Any], Plane | None]:
    """Metres per SfM unit before the joint solve, how it was found, and the floor."""
    cameras, turn = inputs.cameras, solver.world.turn.double().numpy()
    with torch.no_grad():
        skin = solver.surface(state, solver.marks)[0]
        trunks = (turn.transpose(0, 2, 1) @ state.root.double().numpy())[:, :, 1]
    times = solver.world.times.double().numpy()
    held = camera_up(cameras.viewmats[seen])[0]
    path = TimedCameras(
        cameras.viewmats[seen], cameras.Ks[seen], cameras.centers[seen], times, (cameras.width, cameras.height)
    )
    return find_scale(
        path if inputs.moving else None,
        points,
        skin.double().numpy() @ turn,
        solver.soles.shape[1],
        solver.evidence.height,
        np.stack([held, trunk_up(trunks, held)]),
    )


def _slope_of(solver: Solver, state: State, viewmats: np.ndarray, floor: Plane) -> tuple[np.ndarray, float] | None:
    """What is up where the floor slopes, by cameras `viewmats` [F,4,4] and by bodies that nothing has set upright yet."""
    with torch.no_grad():
        mass, soles = mass_and_soles(solver.pose(state)[1] @ solver.world.turn)
        bodies = torch.nn.functional.normalize(mass - soles.mean(1), dim=-1).double().numpy()
    return up_on_slope(viewmats, floor.normal, bodies)


def _extend_to_all_frames(solver: Solver, whole: Solver, state: State, times: np.ndarray, seen: np.ndarray) -> State:
    """The state of all frames, which `whole` solves, from that of the seen ones; others are filled in between, in the world."""
    if len(seen) == len(times):
        return state
    spot = solver.to_world(state, state.place[:, None], state.scale)[:, 0]
    orient = rotvec_from_matrix(solver.world.turn.mT @ state.root)
    known = [np.asarray(part, np.float64) for part in (orient, spot, state.pose)]
    filled = fill_poses(known[0], known[1], known[2], times[seen], times)
    orient, spot, pose = (torch.tensor(part, dtype=torch.float32) for part in filled)
    turn = whole.world.turn
    place = (turn @ (spot - state.scale * whole.world.center)[..., None])[..., 0]
    return replace(state, root=turn @ matrix_from_rotvec(orient), place=place, pose=pose)


def _body_poses(solver: Solver, state: State, cameras: Cameras, confidence: np.ndarray) -> BodyPoses:
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

"""Moves a body from the camera of the tool that fitted it into the clip's cameras and world."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.given_fits.record import SmplFit
from stages.records import BodyModel, BodyPoses

VARIES, EXTREME = 1e-3, 5.0


def median_shape(fit: SmplFit) -> tuple[np.ndarray, tuple[str, ...]]:
    """One shape for all rows, their median [10], and notes on it."""
    shape, notes = np.median(fit.betas, 0), []
    spread = np.ptp(fit.betas, axis=0).max()
    if spread > VARIES:
        notes.append(f"betas vary by up to {spread:.2g} over the frames; their median is kept")
    if np.abs(shape).max() > EXTREME:
        notes.append(f"betas reach {np.abs(shape).max():.1f}: an extreme shape")
    return shape, tuple(notes)


def place_in_world(
    fit: SmplFit,
    names: tuple[str, ...],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    model: BodyModel,
    world_from_sfm: float | None = None,
) -> BodyPoses:
    """The fit's poses in the world (metres, SfM axes), of frames `names` [N], seen by each frame's camera as by the tool.

    `viewmats` [N,4,4] camera_from_sfm in SfM units and `Ks` [N,3,3] px, row by row. A fit in camera frames needs
    `world_from_sfm`; one in the SfM frame gives it: one over its median scale, each body moved along its ray to that
    scale. SMPL turns about its pelvis J0, which is not its origin, so what is moved is the pelvis:
    transl = R^T (J0 + t) - J0 - w R^T T.
    """
    back = Rotation.from_matrix(viewmats[:, :3, :3]).inv()
    centers = -back.apply(viewmats[:, :3, 3])  # by scipy's exact rotation; `camera_centers` differs in the last bits
    regressor = model.J_regressor[0].astype(np.float64)
    rest = regressor @ model.v_template + fit.betas @ np.einsum("v,vcb->bc", regressor, model.shapedirs)
    rest = rest if fit.pelvis is None else np.tile(fit.pelvis, (len(fit), 1))
    pelvis = rest if fit.turns is None else Rotation.from_rotvec(fit.turns).apply(rest)
    orient = Rotation.from_rotvec(fit.global_orient)
    if fit.scale is not None:
        world_from_sfm = 1 / float(np.median(fit.scale))
        away = pelvis + (fit.transl - centers) / fit.scale[:, None]
    else:
        if world_from_sfm is None:
            raise ValueError("a fit in camera frames needs world_from_sfm")
        seen = pelvis + fit.transl
        _check_in_front(fit, names, seen)
        if fit.focal is not None and fit.center is not None:
            seen, turned = _change_camera(seen, fit.focal, fit.center, Ks)
            orient = turned * orient
        away, orient = back.apply(seen), back * orient
    if fit.offset is not None:
        away = away + orient.apply(fit.offset)
    shape = median_shape(fit)[0]
    own = regressor @ (model.v_template + model.shapedirs @ shape)
    transl = away + world_from_sfm * centers - own
    return BodyPoses(names, shape, orient.as_rotvec(), fit.body_pose, transl, np.ones(len(fit)), float(world_from_sfm))


def _change_camera(
    seen: np.ndarray, focal: np.ndarray, center: np.ndarray, Ks: np.ndarray
) -> tuple[np.ndarray, Rotation]:
    """Points `seen` [N,3] m by cameras of `focal` [N] and `center` [N,2] px, where cameras `Ks` see them as large and
    on the same pixel; and how bodies there must turn to be seen from the same side.

    With another focal length a point as large lies at another depth, z' = z f'/f, and its ray at another angle.
    """
    pixels = focal[:, None] * seen[:, :2] / seen[:, 2:] + center
    depth = seen[:, 2] * Ks[:, 0, 0] / focal
    there = (pixels - Ks[:, :2, 2]) / Ks[:, [0, 1], [0, 1]] * depth[:, None]
    there = np.concatenate([there, depth[:, None]], 1)
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (seen, there))
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, (a * b).sum(1, keepdims=True))
    return there, Rotation.from_rotvec(axis / np.where(sine > 0, sine, 1) * angle)


def _check_in_front(fit: SmplFit, names: tuple[str, ...], pelvis: np.ndarray) -> None:
    behind = np.flatnonzero(pelvis[:, 2] <= 0.1)
    if len(behind):
        i = int(behind[0])
        facts = [f"{len(behind)} of {len(fit)} frames; first {names[i]}: depth {pelvis[i, 2]:.3f} m"]
        hint = "without `scale` the file must be in camera axes (x right, y down, z forward), in metres"
        raise StageError(f"{fit.path} puts the person behind the camera", hint, facts)

"""Brings an SMPL fit made by another program into the clip's world: frames joined, person chosen, one scale, gaps filled."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import Body
from stages.avatar.body.smpl_rest import smpl_rest
from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.estimators.bodyfit.contact import sole_vertices
from stages.estimators.bodyfit.fit import KNOWN
from stages.estimators.bodyfit.frames import join_frames
from stages.estimators.bodyfit.from_points import from_points
from stages.estimators.bodyfit.gravity import camera_up, trunk_up
from stages.estimators.bodyfit.inputs import Inputs
from stages.estimators.bodyfit.person import choose_person
from stages.estimators.bodyfit.placing import median_shape, place_in_world
from stages.estimators.bodyfit.posed import posed_vertices
from stages.estimators.bodyfit.resting import onto_body
from stages.estimators.bodyfit.scale import TimedCameras, find_scale
from stages.estimators.bodyfit.start import fill_poses
from stages.formats.body_model import FREE, SMPL
from stages.formats.given_fits.record import SmplFit
from stages.records import BodyModel, BodyPoses, Cameras

SPARSE = 20  # one vertex of so many stands for the skin
AWAY = 0.05  # m between two pelvises at rest: bodies of one kind are nearer, SMPL's and SMPL-X's are 0.13 apart


def import_fit(fit: SmplFit, clip: Inputs, metres: float | None = None) -> tuple[BodyPoses, dict[str, Any]]:
    """The fit as poses of all cameras of the clip (SfM units), and facts for smpl.json: person, scale, notes.

    Its masks choose among several people; `metres` per SfM unit are kept where somebody else in the clip gives them. A fit in
    SfM units brings its scale; for one in camera frames it is found from floor and feet. Frames without a row are filled in
    between with confidence 0.
    """
    model, cameras, times = clip.model, clip.cameras, clip.times
    fit, frames = join_frames(fit, clip.listing)
    if fit.points is not None:
        fit = from_points(fit, model)
    if fit.body == SMPL and (model.name == FREE or (model.fingers is not None and _of_another(fit, model))):
        fit = onto_body(fit, model)
    fit, rows, person = choose_person(fit, frames, cameras, clip.masks, model)
    names = tuple(cameras.names[i] for i in rows)
    poses = place_in_world(fit, names, cameras.viewmats[rows], cameras.Ks[rows], model, 1.0)
    if fit.scale is not None:
        found: dict[str, Any] = {"how": "given by the imported fit"}
    else:
        size = (cameras.width, cameras.height)
        path = TimedCameras(cameras.viewmats[rows], cameras.Ks[rows], cameras.centers[rows], times[rows], size)
        found = {"how": KNOWN, "initial": metres}
        if metres is None:
            found = _find_scale(poses, model, path, clip.points, clip.moving)
        scale = found["initial"]
        transl = poses.transl + (scale - 1) * cameras.centers[rows]
        poses = replace(poses, transl=transl, world_from_sfm=scale)
    found["world_from_sfm"] = poses.world_from_sfm
    facts = {"scale": found, **person, "notes": [*fit.notes, *median_shape(fit)[1]]}
    if fit.joints2d is not None:
        facts["tool_joints_off"] = _distance_from_tool_joints(fit.joints2d, poses, cameras, rows, model)
    return _fill_gaps(poses, rows, cameras.names, times), facts


def _of_another(fit: SmplFit, model: BodyModel) -> bool:
    """Whether the tool's body, by where its pelvis rests, is another than the user's SMPL-H or SMPL-X `model`."""
    pelvis = smpl_rest()[0] if fit.pelvis is None else fit.pelvis
    return bool(np.linalg.norm(model.J_regressor[0] @ model.v_template - pelvis) > AWAY)


def _distance_from_tool_joints(
    joints2d: np.ndarray, poses: BodyPoses, cameras: Cameras, rows: np.ndarray, model: BodyModel
) -> float | None:
    """Median distance of the placed body's joints from the tool's own `joints2d` [N,24,2] px, as share of the height."""
    zero = np.zeros((len(poses), 3))
    parts = (torch.tensor(a, dtype=torch.float32) for a in (poses.betas, poses.global_orient, poses.body_pose, zero))
    joints = Body(model)(*parts)[1].double().numpy() + poses.transl[:, None]
    pixels, _ = project(joints, rescale_viewmats(cameras.viewmats[rows], poses.world_from_sfm), cameras.Ks[rows])
    height = np.ptp(pixels[..., 1], axis=1)[:, None]
    off = np.linalg.norm(pixels - joints2d, axis=-1) / np.maximum(height, 1)
    return None if np.isnan(off).all() else round(float(np.nanmedian(off)), 4)


def _find_scale(
    poses: BodyPoses, model: BodyModel, path: TimedCameras, points: np.ndarray, moving: bool
) -> dict[str, Any]:
    """The scale of `poses` that were placed with 1 m per SfM unit, and how it was found."""
    vertices = np.stack(list(posed_vertices(model, poses)))
    extent = np.ptp(project(vertices, path.viewmats, path.Ks)[0], axis=1)
    held, trunks = camera_up(path.viewmats)[0], matrix_from_rotvec(torch.tensor(poses.global_orient))[:, :, 1].numpy()
    ups = np.stack([held, trunk_up(trunks, held)])
    soles = sole_vertices(Body(model)).numpy()
    skin = vertices[:, np.concatenate([soles.ravel(), np.arange(0, vertices.shape[1], SPARSE)])] - path.centers[:, None]
    height = np.hypot(extent[:, 0], extent[:, 1])
    return find_scale(path if moving else None, points, skin, soles.shape[1], height, ups)[0]


def _fill_gaps(poses: BodyPoses, rows: np.ndarray, names: tuple[str, ...], times: np.ndarray) -> BodyPoses:
    """`poses` of the frames `rows` as poses of all `names`, the others filled in between with confidence 0."""
    orient, transl, pose = fill_poses(poses.global_orient, poses.transl, poses.body_pose, times[rows], times)
    confidence = np.zeros(len(names))
    confidence[rows] = poses.confidence
    return replace(poses, names=names, global_orient=orient, transl=transl, body_pose=pose, confidence=confidence)

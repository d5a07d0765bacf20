"""Brings an SMPL fit made by another program into the clip's world: frames joined, one scale, gaps filled."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from stages.avatar.body import Body
from stages.avatar.cameras import project
from stages.avatar.rotations import matrix_from_rotvec
from stages.estimators.bodyfit_judge import posed_vertices
from stages.estimators.bodyfit_scale import Views, find_scale
from stages.estimators.bodyfit_solve import sole_vertices
from stages.estimators.bodyfit_start import fill_poses
from stages.formats.body_model import BodyModel
from stages.formats.cameras import Cameras
from stages.formats.poses import BodyPoses
from stages.formats.smpl_fits import SmplFit, match_frames, place_in_world


def import_fit(
    fit: SmplFit, model: BodyModel, cameras: Cameras, times: np.ndarray, points: np.ndarray | None, moving: bool
) -> tuple[BodyPoses, dict[str, Any]]:
    """The fit as poses of all `cameras` (SfM units), and how the scale was found.

    A fit in SfM units brings its scale; for one in camera frames it is found from floor and feet. Frames without a row
    are filled in between with confidence 0.
    """
    fit, kept, _ = match_frames(fit, cameras.names)
    rows = np.array([cameras.names.index(name) for name in kept])
    if fit.scale is not None:
        poses = place_in_world(fit, cameras.viewmats[rows], model)
        found: dict[str, Any] = {"how": "given by the imported fit"}
    else:
        poses = place_in_world(fit, cameras.viewmats[rows], model, 1.0)
        views = Views(cameras.viewmats[rows], cameras.Ks[rows], cameras.centers[rows], times[rows])
        found = _scale(poses, model, views, points, moving)
        scale = found["initial"]
        moved = poses.transl + (scale - 1) * cameras.centers[rows]
        poses = replace(poses, transl=moved, world_from_sfm=scale)
    found["world_from_sfm"] = poses.world_from_sfm
    return _complete(poses, rows, cameras.names, times), found


def _scale(poses, model, views, points, moving):
    """The scale of `poses` that were placed with 1 m per SfM unit."""
    soles = sole_vertices(Body(model))
    vertices = np.stack(list(posed_vertices(model, poses)))
    pixels, _ = project(vertices, views.viewmats, views.Ks)
    extent = np.ptp(pixels, axis=1)
    feet = vertices[:, soles.numpy()] - views.centers[:, None, None]
    up = matrix_from_rotvec(torch.tensor(poses.global_orient))[:, :, 1].mean(0).numpy()
    at_feet = pixels[:, soles.flatten().numpy()]
    height = np.hypot(extent[:, 0], extent[:, 1])
    return find_scale(views if moving else None, points, feet, at_feet, height, up)[0]


def _complete(poses: BodyPoses, rows: np.ndarray, names: tuple[str, ...], times: np.ndarray) -> BodyPoses:
    """`poses` of frames `rows` as poses of all `names`."""
    orient, transl, pose = fill_poses(poses.global_orient, poses.transl, poses.body_pose, times[rows], times)
    confidence = np.zeros(len(names))
    confidence[rows] = poses.confidence
    return replace(poses, names=names, global_orient=orient, transl=transl, body_pose=pose, confidence=confidence)

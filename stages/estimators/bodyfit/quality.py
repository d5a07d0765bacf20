"""Measures how well a fitted body lies on the frames: overlap of outlines, distance of landmarks, joints that jump."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from stages.avatar.body.rotations import angle_between, matrix_from_rotvec
from stages.avatar.cameras.pinhole import rescale_viewmats
from stages.avatar.kernels.mesh import covered
from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.estimators.bodyfit.posed import posed_vertices
from stages.records import JOINT_NAMES, BodyModel, BodyPoses, Cameras

SIDE = 480  # px of the longer side at which outlines are compared
FAST = 20.0  # rad/s: no joint of a person turns faster
WORST_ERROR, WORST_IOU, BEST_IOU = 0.03, 0.4, 0.75  # share of the height at half confidence; IoU at none and at full


@dataclass(frozen=True)
class FitQuality:
    """Of F frames: `error_px` mean distance of the sure landmarks, `iou` of body and mask (both NaN where unknown),
    `confidence` 0..1, and `fast`: the joint that turns faster than FAST there, or ''."""

    error_px: np.ndarray
    iou: np.ndarray
    confidence: np.ndarray
    fast: list[str]


def measure_quality(
    poses: BodyPoses,
    model: BodyModel,
    cameras: Cameras,
    times: np.ndarray,
    masks: list[np.ndarray] | None,
    evidence: LandmarkEvidence | None = None,
    pixels: np.ndarray | None = None,
) -> FitQuality:
    """Compare `poses` (in the cameras' order) with the masks, and `pixels` [F,K,2] with the evidence's landmarks.

    A frame the fit had no person for (confidence 0) stays at 0.
    """
    count = len(poses)
    error, share, iou = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    if evidence is not None and pixels is not None:
        off = np.linalg.norm(pixels - evidence.xy, axis=-1).clip(max=math.hypot(cameras.width, cameras.height))
        for i in range(count):
            sure = evidence.weight[i] > 0.5
            if sure.any():
                error[i] = off[i, sure].mean()
                share[i] = (
                    np.median(off[i, sure]) / evidence.height[i]
                )  # a median: one wrong landmark does not make a bad pose
    if masks is not None:
        views = rescale_viewmats(cameras.viewmats, poses.world_from_sfm)
        for i, vertices in enumerate(posed_vertices(model, poses)):
            if (masks[i] > 127).any():
                iou[i] = outline_iou(vertices, model.faces, views[i], cameras.Ks[i], masks[i])
    quality = np.ones(count)
    quality = np.where(np.isnan(share), quality, 1 / (1 + (share / WORST_ERROR) ** 2))
    seen_iou = np.clip((iou - WORST_IOU) / (BEST_IOU - WORST_IOU), 0, 1)
    quality = np.where(np.isnan(iou), quality, np.minimum(quality, seen_iou))
    return FitQuality(error, iou, quality * (poses.confidence > 0), fast_joints(poses, times))


def outline_iou(vertices: np.ndarray, faces: np.ndarray, viewmat: np.ndarray, K: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of the drawn body and the mask, at no more than SIDE px."""
    rows, columns = mask.shape
    ratio = min(1.0, SIDE / max(rows, columns))
    small = cv2.resize(mask, (round(columns * ratio), round(rows * ratio)), interpolation=cv2.INTER_AREA) > 127
    zoom = np.diag([small.shape[1] / columns, small.shape[0] / rows, 1.0])
    drawn = covered(vertices, faces, viewmat, zoom @ K, small.shape[1], small.shape[0])
    union = (drawn | small).sum()
    return float((drawn & small).sum() / union) if union else float("nan")


def fast_joints(poses: BodyPoses, times: np.ndarray) -> list[str]:
    """For each frame the joint that turns fastest into it, if faster than FAST, else ''; geodesic, by the frame times."""
    turns = matrix_from_rotvec(
        torch.tensor(np.concatenate([poses.global_orient, poses.body_pose], 1)).unflatten(-1, (24, 3))
    )
    speed = angle_between(turns[1:], turns[:-1]).numpy() / np.maximum(np.diff(times), 1e-6)[:, None]
    return [""] + [JOINT_NAMES[row.argmax()] if row.max() > FAST else "" for row in speed]

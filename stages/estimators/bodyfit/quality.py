"""How well a fitted body lies on the frames: outlines compared, landmarks compared, joints that jump."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from stages.avatar.body.rotations import angle_between, matrix_from_rotvec
from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.estimators.bodyfit.evidence import Evidence
from stages.records import JOINT_NAMES, BodyModel, BodyPoses, Cameras

SIDE = 480  # px of the longer side at which outlines are compared
FAST = 20.0  # rad/s: no joint of a person turns faster
WORST_ERROR, WORST_IOU, BEST_IOU = 0.03, 0.4, 0.75  # share of the height at half confidence; IoU at none and at full


@dataclass(frozen=True)
class Verdict:
    """Of F frames: `error_px` mean distance of the sure landmarks, `iou` of body and mask (both NaN where unknown),
    `confidence` 0..1, and `fast`: the joint that turns faster than FAST there, or ''."""

    error_px: np.ndarray
    iou: np.ndarray
    confidence: np.ndarray
    fast: list[str]


def judge(
    poses: BodyPoses,
    model: BodyModel,
    cameras: Cameras,
    times: np.ndarray,
    masks: list[np.ndarray] | None,
    evidence: Evidence | None = None,
    pixels: np.ndarray | None = None,
) -> Verdict:
    """Compare `poses` (in the cameras' order) with the masks, and `pixels` [F,K,2] with the evidence's landmarks.

    A frame the fit had no person for (confidence 0) stays at 0.
    """
    count = len(poses)
    error, share, iou = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
    if evidence is not None and pixels is not None:
        off = np.linalg.norm(pixels - evidence.xy, axis=-1)
        for i in range(count):
            sure = evidence.weight[i] > 0.5
            if sure.any():
                error[i] = off[i, sure].mean()
                share[i] = np.median(off[i, sure]) / evidence.height[i]  # one wild landmark is no bad pose
    if masks is not None:
        views = rescale_viewmats(cameras.viewmats, poses.world_from_sfm)
        for i, vertices in enumerate(posed_vertices(model, poses)):
            if (masks[i] > 127).any():
                iou[i] = outline_iou(vertices, model.faces, views[i], cameras.Ks[i], masks[i])
    quality = np.ones(count)
    quality = np.where(np.isnan(share), quality, 1 / (1 + (share / WORST_ERROR) ** 2))
    seen_iou = np.clip((iou - WORST_IOU) / (BEST_IOU - WORST_IOU), 0, 1)
    quality = np.where(np.isnan(iou), quality, np.minimum(quality, seen_iou))
    return Verdict(error, iou, quality * (poses.confidence > 0), fast_joints(poses, times))


def posed_vertices(model: BodyModel, poses: BodyPoses):
    """Vertices [V,3] m in the world of each frame in turn."""
    body = Body(model)
    tensor = lambda a: torch.tensor(a, dtype=torch.float32)  # noqa: E731
    betas = tensor(poses.betas)
    for i in range(len(poses)):
        part = (tensor(a[i : i + 1]) for a in (poses.global_orient, poses.body_pose, np.zeros((len(poses), 3))))
        yield body(betas, *part)[0][0].double().numpy() + poses.transl[i]


def outline_iou(vertices: np.ndarray, faces: np.ndarray, viewmat: np.ndarray, K: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of the drawn body and the mask, at no more than SIDE px."""
    rows, columns = mask.shape
    ratio = min(1.0, SIDE / max(rows, columns))
    small = cv2.resize(mask, (round(columns * ratio), round(rows * ratio)), interpolation=cv2.INTER_AREA) > 127
    drawn = silhouette(vertices, faces, viewmat, K, (rows, columns), small.shape)
    union = (drawn | small).sum()
    return float((drawn & small).sum() / union) if union else float("nan")


def silhouette(
    vertices: np.ndarray,
    faces: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    shape: tuple[int, int],
) -> np.ndarray:
    """The body drawn as bool `shape` (rows, columns) for a camera whose picture has `size` (rows, columns)."""
    pixels, z = project(vertices, viewmat, K)
    pixels = pixels * np.array([shape[1] / size[1], shape[0] / size[0]])
    corners = pixels[faces]
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    front = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0] < 0
    shown = front & (z[faces] > 0.05).all(1) & (np.abs(corners) < 4 * max(shape)).all((1, 2))
    canvas = np.zeros(shape, np.uint8)
    for triangle in np.rint(corners[shown] * 16 - 8).astype(np.int32):
        cv2.fillConvexPoly(canvas, triangle, 1, shift=4)
    return canvas.astype(bool)


def fast_joints(poses: BodyPoses, times: np.ndarray) -> list[str]:
    """For each frame the joint that turns fastest into it, if faster than FAST, else ''; geodesic, by the frame times."""
    turns = matrix_from_rotvec(
        torch.tensor(np.concatenate([poses.global_orient, poses.body_pose], 1)).unflatten(-1, (24, 3))
    )
    speed = angle_between(turns[1:], turns[:-1]).numpy() / np.maximum(np.diff(times), 1e-6)[:, None]
    return [""] + [JOINT_NAMES[row.argmax()] if row.max() > FAST else "" for row in speed]

"""How far a fitted body is from the true one, so that a bias shows as a bias: signed along the view, and against gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stages.avatar.body.joints import ANKLES, FEET
from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.contact import sole_vertices
from stages.estimators.bodyfit.posed import posed_vertices
from stages.records import JOINT_NAMES, BodyModel, BodyPoses, Cameras
from stages.smpl import Params
from tests.made.family.evidence import Truth
from tests.made.truth import Similarity, align, joints_of, rows
from tests.made.worlds import umeyama

STANDS = 0.02
"""m that a true sole may move between two frames and still stand."""
LOW = 0.015
"""m over its lowest place up to which a true sole, bare or in a shoe, stands on the floor."""
HEAD, NECK = JOINT_NAMES.index("head"), JOINT_NAMES.index("neck")
TOES_AND_ANKLES = [*FEET, *ANKLES]
DOUBTFUL = Params().doubtful
"""Confidence below which a run marks a frame's pose."""
UPRIGHT = 0.25
"""m between pelvis and neck, seen from the side, from which there is a lean to speak of."""
COLUMNS = {
    "world": "joints, cm",
    "worst": "frame with the largest mean over joints, cm",
    "pelvis": "joints, pelvis on pelvis, cm",
    "procr": "joints after a similarity a frame, cm",
    "along": "pelvis along the view, cm; negative: too near",
    "across": "pelvis across the view, cm",
    "head-ft": "head less feet along the view, cm; negative: leans toward the camera",
    "lean": "pelvis to neck against the truth in the plane of view and gravity, degrees; positive: toward the camera",
    "slide": "standing feet, cm a frame",
    "tall%": "stature against the truth",
    "beta": "largest shape",
    "scale%": "metres per SfM unit against the truth (still camera: the depth of the pelvis)",
    "heading": "largest error of the pelvis' turn about its own up axis in frames not marked doubtful, degrees",
    "IoU": "our masks against the true ones",
}


def measured(
    poses: BodyPoses, model: BodyModel, cameras: Cameras, moving: bool, truth: Truth, masks=()
) -> dict[str, float]:
    """The measures of COLUMNS for `poses` of `model` in the world of `cameras` (SfM units), all about the truth's metres."""
    order = rows(poses.names, truth.poses.names)
    wanted, ours = joints_of(truth.poses, truth.model)[order], joints_of(poses, model)
    views = truth.cameras.viewmats[rows(poses.names, truth.cameras.names)]
    similarity = between(poses, cameras, moving, truth, ours, wanted)
    found = similarity.to_truth(ours)
    gap = found - wanted
    each = np.linalg.norm(gap, axis=-1)
    away = wanted[:, 0] + (views[:, :3, :3].mT @ views[:, :3, 3:])[..., 0]  # from the camera to the pelvis
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    along = np.einsum("fjc,fc->fj", gap, away)
    tall = similarity.scale * stature(model, poses) / stature(truth.model, truth.poses)
    soles = [soles_of(model, poses), soles_of(truth.model, truth.poses)[order]]
    values = (
        100 * each.mean(),
        100 * each.mean(1).max(),
        100 * np.linalg.norm(gap - gap[:, :1], axis=-1).mean(),
        100 * np.mean([_procrustes(a, b) for a, b in zip(found, wanted)]),
        100 * along[:, 0].mean(),
        100 * np.linalg.norm(gap[:, 0] - along[:, :1] * away, axis=1).mean(),
        100 * (along[:, HEAD] - along[:, TOES_AND_ANKLES].mean(1)).mean(),
        _lean(found, wanted, away),
        100 * sliding(similarity.to_truth(soles[0]), soles[1]),
        100 * (tall - 1),
        abs(poses.betas).max(),
        100 * (1 / similarity.scale - 1),
        heading_off(poses, cameras, truth, order)[poses.confidence >= DOUBTFUL].max(initial=0),
        np.mean([_iou(a, b) for a, b in zip(masks, truth.masks)]) if len(masks) else np.nan,
    )
    return dict(zip(COLUMNS, map(float, values), strict=True))


def heading_off(poses: BodyPoses, cameras: Cameras, truth: Truth, order: np.ndarray) -> np.ndarray:
    """By how many degrees [F] each pelvis is turned about the true one's up axis, in camera axes; `order` [F] are truth's rows."""
    ours, true = (
        Rotation.from_matrix(view[:, :3, :3]) * Rotation.from_rotvec(orient)
        for view, orient in (
            (cameras.viewmats, poses.global_orient),
            (truth.cameras.viewmats[rows(poses.names, truth.cameras.names)], truth.poses.global_orient[order]),
        )
    )
    ahead = (true.inv() * ours).as_matrix()[..., 2]
    return abs(np.degrees(np.arctan2(ahead[:, 0], ahead[:, 2])))


def between(
    poses: BodyPoses, cameras: Cameras, moving: bool, truth: Truth, ours: np.ndarray, wanted: np.ndarray
) -> Similarity:
    """From the world of `poses` to the truth's; `ours` and `wanted` are the joints [F,24,3] in either.

    How the film made SfM's world is known. Cameras alone tell it badly where they hardly travel: with a path of 5 mm and
    centres 1 mm off, the true body itself came out 72 cm away.
    """
    if not moving:
        return still(ours, wanted, truth.cameras.viewmats[rows(poses.names, truth.cameras.names)][0])
    if truth.to_truth is None:
        return align(cameras, truth.cameras, poses.world_from_sfm)
    return replace(truth.to_truth, scale=truth.to_truth.scale / poses.world_from_sfm)


def still(ours: np.ndarray, wanted: np.ndarray, view: np.ndarray) -> Similarity:
    """From a still camera's own frame to the truth's world: what one camera cannot know, how large all is, is taken from
    the depths of the pelvis."""
    a, b = ours[:, 0, 2], (wanted[:, 0] @ view[:3, :3].T + view[:3, 3])[:, 2]
    return Similarity(float((a * b).sum() / (a * a).sum()), view[:3, :3].T, -view[:3, :3].T @ view[:3, 3])


def stature(model: BodyModel, poses: BodyPoses) -> float:
    """Height of the body at rest, m."""
    return float(np.ptp((model.v_template + model.shapedirs @ poses.betas)[:, 1]))


def soles_of(model: BodyModel, poses: BodyPoses) -> np.ndarray:
    """Points under both feet [F,2,S,3] m."""
    soles = sole_vertices(Body(model)).numpy()
    return np.stack([vertices[soles] for vertices in posed_vertices(model, poses)])


def sliding(found: np.ndarray, true: np.ndarray) -> float:
    """How far in m the soles [F,2,S,3] of a standing foot move from a frame to the next beyond the true ones, on average.

    NaN if none stands. A foot stands where its true sole moves less than STANDS and, in both frames, is within LOW of
    the lowest that true soles are in the clip.
    """
    moved, truly = (np.diff(feet.mean(2), axis=0) for feet in (found, true))
    low = true[..., 1].min(2) < true[..., 1].min() + LOW
    stands = low[1:] & low[:-1] & (np.linalg.norm(truly, axis=-1) < STANDS)
    return float(np.linalg.norm(moved - truly, axis=-1)[stands].mean()) if stands.any() else np.nan


def _procrustes(found: np.ndarray, wanted: np.ndarray) -> float:
    scale, turn, shift = umeyama(found, wanted)
    return float(np.linalg.norm(scale * found @ turn.T + shift - wanted, axis=1).mean())


def _lean(found: np.ndarray, wanted: np.ndarray, away: np.ndarray) -> float:
    """Mean angle in degrees by which pelvis to neck is turned toward the camera; NaN for somebody who lies across the view."""
    toward = -away * [1, 0, 1]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    angles, lengths = [], []
    for joints in (found, wanted):
        trunk = joints[:, NECK] - joints[:, 0]
        ahead = (trunk * toward).sum(1)
        angles.append(np.arctan2(ahead, trunk[:, 1]))
        lengths.append(np.hypot(ahead, trunk[:, 1]))
    off = (angles[0] - angles[1] + np.pi) % (2 * np.pi) - np.pi
    shown = np.minimum(*lengths) > UPRIGHT
    return float(np.degrees(off[shown].mean())) if shown.any() else np.nan


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a > 127, b > 127
    return float((a & b).sum() / max((a | b).sum(), 1))

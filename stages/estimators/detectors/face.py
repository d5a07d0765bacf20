"""A face that talks: is it large enough where it looks at the camera, and does nothing hide it?"""

from __future__ import annotations

import numpy as np
import torch

from stages.avatar.body.face import face_at
from stages.avatar.body.joints import HEAD
from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import project
from stages.avatar.model.person import bone_transforms
from stages.contract import StageError
from stages.estimators.detectors.evidence import FRAMES, ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.estimators.person.crops import Roi
from stages.estimators.person.face_network import FaceNetwork
from stages.formats.clip import Clip
from stages.formats.hands_face import read_hands_face
from stages.formats.images import evenly
from stages.gestures import HandsFace

HIGH = 48.0  # px: at 62 a smile, a blink and an open mouth are told apart
MOVES = 2e-3  # m: what a shape moves so far is of the face; turned eyes move by 3
AHEAD = 0.5  # cosine of the angle between where a face looks and the camera, at least
LEAST = 5  # frames in which it does
SURE = 0.5  # probability that a frame shows a face
SEEN = 0.5  # share of the frames that show one, at least
UNIT = "px, the height of the face"
SHARE = "of the frames show the face"
UP = 0.05  # m along a head, whose picture gives the crop its up direction


def detect(evidence: ClipEvidence) -> Finding:
    """The median height of the face in frames in which it looks at the camera; if large but hidden, the share that shows it.

    Nobody needs a face, so a network that has not been fetched stops no run.
    """
    clip, rig = evidence.clip, read_hands_face(evidence.clip.body_model)
    if clip.body.face is not None:
        return Finding(None, UNIT, HIGH, "given by `--face`", True, 0.0)
    if rig is None or not len(rig.face_points):
        return unmeasured(UNIT, HIGH, "the body model has no face that moves")
    placed, heads = faces_of(clip, rig)
    centers = -np.einsum("fji,fj->fi", clip.viewmats[:, :3, :3], clip.viewmats[:, :3, 3])
    to_camera = centers - placed.mean(1)
    ahead = (to_camera * heads[:, :, 2]).sum(1) > AHEAD * np.linalg.norm(to_camera, axis=1)
    pixels = project(placed, clip.viewmats, clip.Ks)[0]
    heights = np.ptp(pixels[..., 1], axis=1)
    heights[~(ahead & (clip.body.confidence > 0))] = np.nan
    looking = np.flatnonzero(~np.isnan(heights))
    if len(looking) < LEAST:
        return unmeasured(UNIT, HIGH, f"the face looks at the camera in fewer than {LEAST} frames")
    names = strongest_frames(clip.names, heights)
    found = compare(float(np.nanmedian(heights)), UNIT, HIGH, ("large enough", "too small"), names)
    if not found.called_for:
        return found
    try:
        network = FaceNetwork()
    except StageError as error:
        return unmeasured(SHARE, SEEN, f"{error.problem}; {error.hint}, then `hugs run VIDEO survey --force`")
    middle, presence = placed.mean(1), np.full(len(clip.names), np.nan)
    dx, dy = np.diff(project(np.stack([middle, middle + UP * heads[:, :, 1]], 1), clip.viewmats, clip.Ks)[0], axis=1).T
    for i in looking[evenly(len(looking), FRAMES)]:
        face = Roi.fitting(pixels[i], float(np.arctan2(dx[0, i], -dy[0, i])))
        presence[i] = network.presence(clip.images(i), face)
    share = float((presence > SURE).sum() / np.isfinite(presence).sum())
    if share >= SEEN:
        return found
    return compare(share, SHARE, SEEN, ("seen", "hidden or blurred"), strongest_frames(clip.names, -presence))


def faces_of(clip: Clip, rig: HandsFace) -> tuple[np.ndarray, np.ndarray]:
    """Points [F,N,3] m of the fitted face at rest that move in it, and the axes [F,3,3] of the head, in the world."""
    body, poses = Body(clip.body_model), clip.body
    betas = torch.as_tensor(poses.betas).float()
    moving = np.linalg.norm(rig.face_shapes, axis=2).max(0) > MOVES
    points, joints = face_at(rig, body.v_template, body.shapedirs, betas)[moving], body.rest(betas)[1]
    turns = (torch.as_tensor(part).float() for part in (poses.global_orient, poses.body_pose))
    heads = bone_transforms(joints, body.parents, *turns)[:, HEAD].numpy()
    axes = heads[:, :3, :3]
    return points.numpy() @ axes.transpose(0, 2, 1) + heads[:, None, :3, 3] + poses.transl[:, None], axes

"""A face that talks: is it large enough where it looks at the camera?"""

from __future__ import annotations

import numpy as np
import torch

from stages.avatar.body.face import face_at
from stages.avatar.body.joints import HEAD
from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import project
from stages.avatar.model.person import bone_transforms
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.formats.hands_face import read_hands_face

HIGH = 48.0  # px: at 62 a smile, a blink and an open mouth are told apart
MOVES = 3e-3  # m: what a shape moves so far is of the face
AHEAD = 0.5  # cosine of the angle between where a face looks and the camera, at least
LEAST = 5  # frames in which it does
UNIT = "px, the height of the face"


def detect(evidence: ClipEvidence) -> Finding:
    """The median height of the face in frames in which it looks at the camera."""
    clip, rig = evidence.clip, read_hands_face(evidence.clip.body_model)
    if clip.body.face is not None:
        return Finding(None, UNIT, HIGH, "given: `--face`", False, 0.0)
    if rig is None or not len(rig.face_points):
        return unmeasured(UNIT, HIGH, "the body model has no face that moves")
    body, poses = Body(clip.body_model), clip.body
    betas = torch.as_tensor(poses.betas).float()
    moving = np.linalg.norm(rig.face_shapes, axis=2).max(0) > MOVES
    points, joints = face_at(rig, body.v_template, body.shapedirs, betas)[moving], body.rest(betas)[1]
    turns = (torch.as_tensor(part).float() for part in (poses.global_orient, poses.body_pose))
    heads = bone_transforms(joints, body.parents, *turns)[:, HEAD].numpy()
    placed = points.numpy() @ heads[:, :3, :3].transpose(0, 2, 1) + heads[:, None, :3, 3] + poses.transl[:, None]
    centers = -np.einsum("fji,fj->fi", clip.viewmats[:, :3, :3], clip.viewmats[:, :3, 3])
    to_camera = centers - placed.mean(1)
    ahead = (to_camera * heads[:, :3, 2]).sum(1) > AHEAD * np.linalg.norm(to_camera, axis=1)
    heights = np.ptp(project(placed, clip.viewmats, clip.Ks)[0][..., 1], axis=1)
    heights[~(ahead & (poses.confidence > 0))] = np.nan
    if (~np.isnan(heights)).sum() < LEAST:
        return unmeasured(UNIT, HIGH, f"the face looks at the camera in fewer than {LEAST} frames")
    names = strongest_frames(clip.names, heights)
    return compare(float(np.nanmedian(heights)), UNIT, HIGH, ("large enough", "too small"), names)

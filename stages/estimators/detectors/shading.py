"""Shading: do places on the person brighten and darken with the direction in which they face?"""

from __future__ import annotations

import cv2
import numpy as np
import torch

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.cameras.pinhole import camera_centers, project
from stages.avatar.kernels.mesh import NEAR, fill
from stages.avatar.splats.sh import sh_basis
from stages.estimators.detectors.evidence import ClipEvidence
from stages.estimators.detectors.finding import Finding, compare, strongest_frames, unmeasured
from stages.estimators.detectors.pictures import brightness, sample

CHANGE = 0.06  # of the light on a place, standard deviation over frames
LIKENESS = 0.4  # least correlation of the light that half of the frames tell with the brightness in the others
UNIT = "of the light on a place changes as it turns"
DEGREE = 2  # of the light in spherical harmonics
EVERY, PLACES, LEAST = 3, 100, 5  # vertex; that must be seen in as many frames
FACING, BEHIND = 0.4, 0.02  # cosine towards the camera; m behind the nearest skin from which a vertex is hidden
DARKEST, BRIGHTEST = 12.0, 243.0  # of 255: beyond, a picture does not tell the light
LARGEST = 0.3  # log brightness: more than this is rather a pattern that the pose has shifted
HOLD = 1e-5  # keeps what no frame tells at 0


def detect(evidence: ClipEvidence) -> Finding:
    """How much the light on a place of the body changes as it turns, gains of frames taken off.

    A place is compared with itself alone, so patterns do not matter. Half of the frames tell the light, the others are
    asked: errors of poses shift patterns, too, but not by the direction in which a place faces.
    """
    logs, normals = _places(evidence)
    often = np.isfinite(logs).sum(0) >= LEAST
    if often.sum() < PLACES:
        return unmeasured(UNIT, CHANGE, "too little of the person is seen in several frames")
    logs, basis = logs[:, often], sh_basis(torch.as_tensor(normals[:, often]), DEGREE)[..., 1:].numpy()
    first = np.arange(len(logs)) % 4 < 2
    asked = [(half, basis[half] @ light_of(logs[~half], basis[~half])) for half in (first, ~first)]
    likeness = min(_likeness(logs[half], light) for half, light in asked)
    light = _centered(basis @ light_of(logs, basis), np.isfinite(logs))
    change = np.full(len(evidence.clip.names), np.nan)
    shown = np.isfinite(light).any(1)
    change[np.array(evidence.sampled)[shown]] = np.sqrt(np.nanmean(light[shown] ** 2, axis=1))
    return compare(float(np.sqrt(np.nanmean(light**2))), UNIT, CHANGE, ("shaded", "even"),
                   strongest_frames(evidence.clip.names, change), likeness > LIKENESS)  # fmt: skip


def light_of(logs: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Coefficients [K] of the light that best explains how `logs` [F,P] differ within each place; basis [F,P,K]."""
    known = np.isfinite(logs)
    light = np.stack([_centered(basis[..., k], known)[known] for k in range(basis.shape[-1])], 1)
    seen = _centered(logs, known)[known]
    weighted = light / (1 + (seen / LARGEST) ** 2)[:, None]
    hold = HOLD * len(seen) * np.eye(basis.shape[-1])
    return np.linalg.solve(weighted.T @ light + hold, weighted.T @ seen)


def _places(evidence: ClipEvidence) -> tuple[np.ndarray, np.ndarray]:
    """Log brightness [F,P] of places on the body in the sampled frames, NaN where one is not seen, and normals [F,P,3]."""
    clip, logs, normals = evidence.clip, [], []
    faces = np.asarray(clip.body_model.faces, np.int64)
    for i, body in zip(evidence.sampled, evidence.bodies):
        facing = vertex_normals(torch.as_tensor(body), torch.as_tensor(faces)).numpy()[::EVERY]
        viewmat, K = clip.viewmats[i], clip.Ks[i]
        camera = body @ viewmat[:3, :3].T + viewmat[:3, 3]
        camera[:, 2] = np.maximum(camera[:, 2], NEAR)
        skin = fill(camera, faces, K, clip.width, clip.height)[0]
        pixels, z = project(body[::EVERY], viewmat, K)
        inside = (z > NEAR) & (pixels >= 0).all(1) & (pixels < [clip.width, clip.height]).all(1)
        column, row = np.where(inside[:, None], pixels, 0).astype(int).T
        rays = body[::EVERY] - camera_centers(viewmat[None])[0]
        towards = -(facing * rays).sum(1) / np.linalg.norm(rays, axis=1)
        person = cv2.erode(clip.mask(i), np.ones((5, 5), np.uint8)) > 250
        value = sample(brightness(clip.images(i)), pixels)
        seen = inside & person[row, column] & (towards > FACING) & (z < skin[row, column] + BEHIND)
        seen &= (value > DARKEST) & (value < BRIGHTEST) & (clip.body.confidence[i] > 0)
        gain = evidence.gains[i] if np.isfinite(evidence.gains[i]) else 0.0
        logs.append(np.where(seen, np.log(np.maximum(value, 1)) - gain, np.nan))
        normals.append(facing)
    return np.stack(logs), np.stack(normals)


def _centered(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values [F,P] less the mean of each place over the frames where it is known; NaN elsewhere."""
    mean = np.where(known, values, 0.0).sum(0) / np.maximum(known.sum(0), 1)
    return np.where(known, values - mean, np.nan)


def _likeness(logs: np.ndarray, light: np.ndarray) -> float:
    """Correlation of brightness and told light [F,P] within places; large differences count as 2 LARGEST."""
    known = np.isfinite(logs)
    seen, told = _centered(logs, known)[known].clip(-2 * LARGEST, 2 * LARGEST), _centered(light, known)[known]
    return float((seen * told).sum() / np.sqrt((seen**2).sum() * (told**2).sum() + 1e-12))

"""Pinhole cameras: projection, placing, and the similarity between two worlds.

Axes are OpenCV's (x right, y down, z forward); the centre of the first pixel is at (0.5, 0.5). What is not marked
otherwise takes numpy arrays and torch tensors alike and returns the same kind.
"""

from __future__ import annotations

import numpy as np
import torch

TINY_DEPTH = 1e-9  # a point in the camera plane is divided by this: far outside every image, but finite


def project(points, viewmat, K):
    """Project world `points` [...,N,3] by camera_from_world `viewmat` [...,4,4] and `K` [...,3,3].

    Returns pixels [...,N,2] and depths z [...,N] in world units. Pixels of points with z <= 0 mean nothing; ask z.
    """
    in_camera = points @ viewmat[..., :3, :3].mT + viewmat[..., None, :3, 3]
    z = in_camera[..., 2]
    safe = z + (abs(z) < TINY_DEPTH) * TINY_DEPTH * 2
    homogeneous = (in_camera / safe[..., None]) @ K.mT
    return homogeneous[..., :2], z


def unproject(pixels, depths, viewmat, K):
    """World points [...,N,3] seen at `pixels` [...,N,2] with depths z [...,N]; the inverse of `project`."""
    x = (pixels[..., 0] - K[..., None, 0, 2]) / K[..., None, 0, 0] * depths
    y = (pixels[..., 1] - K[..., None, 1, 2]) / K[..., None, 1, 1] * depths
    stack = np.stack if isinstance(pixels, np.ndarray) else torch.stack
    in_camera = stack([x, y, depths], -1)
    return (in_camera - viewmat[..., None, :3, 3]) @ viewmat[..., :3, :3]


def camera_centers(viewmats):
    """Positions [...,3] of cameras `viewmats` [...,4,4] in the world."""
    return -(viewmats[..., :3, :3].mT @ viewmats[..., :3, 3:])[..., 0]


def rescale_viewmats(viewmats: np.ndarray, world_from_sfm: float) -> np.ndarray:
    """The same cameras [C,4,4] with their world scaled by `world_from_sfm` about its origin."""
    scaled = np.array(viewmats, dtype=np.float64)
    scaled[..., :3, 3] *= world_from_sfm
    return scaled


def pinhole(focal: float, width: int, height: int) -> np.ndarray:
    """K [3,3] float64 of a camera with square pixels that looks through the middle of its image."""
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=np.float64)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """camera_from_world [4,4] float64 of a camera at `eye` [3] that looks at `target` [3] with `up` [3] upwards.

    Looking along `up`, the world axis least aligned with the view takes its place. Raises ValueError if eye is target.
    """
    forward = np.asarray(target, np.float64) - eye
    distance = np.linalg.norm(forward)
    if not distance > 0:
        raise ValueError(f"a camera cannot look at its own position {np.asarray(eye).tolist()}")
    forward = forward / distance
    right = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = right / np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


def umeyama(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The similarity (scale, R [3,3], t [3]) that best takes `source` [N,3] to `target` [N,3] in least squares.

    target ~ scale * R @ source + t, R a rotation (never a mirror). Raises ValueError when the points fix no rotation:
    fewer than 3, all on one line, or not finite. Source: Umeyama 1991, IEEE TPAMI 13(4), eq. 40-43.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"need two equal [N,3] arrays, not {source.shape} and {target.shape}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("points that are not finite fix no rotation")
    mean_source, mean_target = source.mean(0), target.mean(0)
    a, b = source - mean_source, target - mean_target
    U, spread, Vt = np.linalg.svd(b.T @ a / len(a))
    if len(source) < 3 or spread[1] <= 1e-12 * spread[0]:
        raise ValueError(f"{len(source)} points on one line fix no rotation")
    sign = np.ones(3)
    sign[2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = (U * sign) @ Vt
    scale = float((spread * sign).sum() / (a**2).sum(1).mean())
    return scale, R, mean_target - scale * R @ mean_source


def align_viewmats(viewmats: np.ndarray, scale: float, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The cameras `viewmats` [C,4,4] of world A in world B, where B = scale * R @ A + t; distances are then B's."""
    aligned = np.array(viewmats, dtype=np.float64)
    aligned[:, :3, :3] = viewmats[:, :3, :3] @ R.T
    aligned[:, :3, 3] = scale * viewmats[:, :3, 3] - aligned[:, :3, :3] @ t
    return aligned

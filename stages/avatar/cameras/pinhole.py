"""Pinhole cameras: projection and placing.

Axes are OpenCV's (x right, y down, z forward); the centre of the first pixel is at (0.5, 0.5). Functions of
`Array` take numpy arrays or torch tensors and return the same kind.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:  # numpy's users need no torch
    from torch import Tensor

Array = TypeVar("Array", "np.ndarray", "Tensor")
TINY_DEPTH = 1e-9  # a point in the camera plane is divided by this: far outside every image, but finite


def project(points: Array, viewmat: Array, K: Array) -> tuple[Array, Array]:
    """Project world `points` [...,N,3] by camera_from_world `viewmat` [...,4,4] and `K` [...,3,3].

    Returns pixels [...,N,2] and depths z [...,N] in world units. Pixels of points with z <= 0 mean nothing; ask z.
    """
    in_camera = points @ viewmat[..., :3, :3].mT + viewmat[..., None, :3, 3]
    z = in_camera[..., 2]
    safe = z + (abs(z) < TINY_DEPTH) * TINY_DEPTH * 2
    homogeneous = (in_camera / safe[..., None]) @ K.mT
    return homogeneous[..., :2], z


def onto(points: Array, K: Array, nearest: float = -float("inf")) -> Array:
    """Pixels [N,2] of points [N,3] in a camera's axes, by a `K` [3,3] without skew; depths below `nearest` are taken as that."""
    return points[:, :2] / points[:, 2:].clip(nearest) * K.diagonal()[:2] + K[:2, 2]


def unproject(pixels: np.ndarray, inverse: np.ndarray, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    """World points [N,3] of pixels [N,2] with inverse depths 1/z [N], for a `viewmat` [4,4] and a `K` [3,3] without skew."""
    rays = np.concatenate([(pixels - [K[0, 2], K[1, 2]]) / [K[0, 0], K[1, 1]], np.ones((len(pixels), 1))], 1)
    return (rays / inverse[:, None] - viewmat[:3, 3]) @ viewmat[:3, :3]


def camera_centers(viewmats: Array) -> Array:
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

    If `up` is along the view, the world axis farthest from the view replaces it. Raises ValueError if eye is target.
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

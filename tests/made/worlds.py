"""What tests measure cameras with: the similarity between two worlds, and the way back from pixels to points."""

from __future__ import annotations

import numpy as np
import torch


def unproject(pixels, depths, viewmat, K):
    """World points [...,N,3] seen at `pixels` [...,N,2] with depths z [...,N]; the inverse of `project`."""
    x = (pixels[..., 0] - K[..., None, 0, 2]) / K[..., None, 0, 0] * depths
    y = (pixels[..., 1] - K[..., None, 1, 2]) / K[..., None, 1, 1] * depths
    stack = np.stack if isinstance(pixels, np.ndarray) else torch.stack
    in_camera = stack([x, y, depths], -1)
    return (in_camera - viewmat[..., None, :3, 3]) @ viewmat[..., :3, :3]


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

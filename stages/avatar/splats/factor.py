"""Posed Gaussians as files hold them: a rotation, scales, and colours in the axes of the world."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages import records
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import rotate_sh

THINNEST = 1e-9  # m: a scale of 0 has no logarithm, and no picture shows a nanometre


def factored(splats: Splats) -> records.Scene:
    """The Gaussians as arrays. Skinning shears their axes M; M M^T is factored into rotation and scales, which is exact.

    View-dependent colours take the rotation that is nearest to the blend of the bones: exact where one bone moves them.
    """
    means, axes, opacities, sh = (part.detach().cpu() for part in splats[:4])
    turns, scales, _ = np.linalg.svd(axes.numpy().astype(np.float64))
    turns[np.linalg.det(turns) < 0, :, 0] *= -1
    shN = sh[:, 1:]
    if splats.rotations is not None and shN.shape[1]:
        blend = np.linalg.svd(splats.rotations.detach().cpu().numpy().astype(np.float64))
        shN = rotate_sh(shN, torch.from_numpy(blend.U @ blend.Vh))
    return records.Scene(
        means=means.numpy(),
        quats=_quats(turns).astype(np.float32),
        scales=np.maximum(scales, THINNEST).astype(np.float32),
        opacities=opacities.numpy(),
        sh0=sh[:, 0].numpy(),
        shN=shN.numpy(),
        antialias=splats.antialias,
    )


def _quats(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions [N,4], w x y z, w >= 0, of rotations[N,3,3]; none for none."""
    if len(rotations) == 0:
        return np.zeros((0, 4))
    return Rotation.from_matrix(rotations).as_quat(canonical=True, scalar_first=True)

"""Turns a set of Gaussians as a whole, for programs whose axes are not ours."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages import records
from stages.avatar.splats.sh import rotate_sh

OVER = np.diag([1.0, -1.0, -1.0])
"""Half a turn about x: y up and facing z becomes y down and facing -z, and back."""


def turned(splats: records.Scene, rotation: np.ndarray, about: np.ndarray | None = None) -> records.Scene:
    """Gaussians turned by `rotation` [3,3]: places, shapes, and colours that depend on the view.

    `about` [3] m becomes the origin; without it the origin stays.
    """
    turn = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    return records.Scene(
        means=((splats.means if about is None else splats.means - about) @ rotation.T).astype(splats.means.dtype),
        quats=(splats.quats @ _left(turn).T).astype(splats.quats.dtype),
        scales=splats.scales,
        opacities=splats.opacities,
        sh0=splats.sh0,
        shN=rotate_sh(torch.as_tensor(splats.shN), torch.as_tensor(rotation)).numpy(),
        antialias=splats.antialias,
        invented=splats.invented,
        said=splats.said,
    )


def _left(quat: np.ndarray) -> np.ndarray:
    """The matrix [4,4] that takes q to quat * q, both w x y z."""
    w, x, y, z = quat
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])

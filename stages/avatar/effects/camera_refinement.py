"""Camera refinement: a small rotation and shift of each training camera, learned with everything else."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.cameras.pinhole import camera_centers


def correct_cameras(viewmats: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
    """Cameras [...,4,4] turned by turns[...,3] rad and with centres moved by shifts[...,3] m, both in world axes.

    Corrections whose mean over the clip is 0 cannot turn or move the world as a whole.
    """
    rotation = viewmats[..., :3, :3] @ matrix_from_rotvec(turns).mT
    centre = camera_centers(viewmats) + shifts
    return torch.cat([torch.cat([rotation, -rotation @ centre[..., None]], -1), viewmats[..., 3:, :]], -2)

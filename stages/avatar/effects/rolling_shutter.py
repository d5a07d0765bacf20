"""Rolling shutter: the rows of a picture are read one after the other, each from a camera that has moved on."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.effects.speeds import move
from stages.avatar.rasterize.rendering import FRUSTUM_MARGIN, NEAR
from stages.avatar.splats.gaussians import Splats

RUSH = 0.5  # how far the motion itself may change the time at which a point's row is read


def roll_shutter(
    splats: Splats,
    speeds: Tensor,
    spin: Tensor,
    viewmat: Tensor,
    K: Tensor,
    height: int,
    readout: Tensor,
    time: Tensor,
) -> Splats:
    """The Gaussians as seen by a shutter that reads `height` rows in the share `readout` of a moment.

    speeds[N,3] m a moment past the camera, spin[3,3] their change with place; the middle row is read `time` moments
    after that of viewmat[4,4]. Each Gaussian is moved by the time of its own row, and sheared as that time changes
    across it: exact to first order in `readout`, at the cost of one picture (Seiskari et al. 2024, arXiv 2403.13327,
    move means on the screen). Far outside the picture the time is that of its edge, behind the camera that of the
    middle. A negative readout reads upwards.
    """
    rotation = viewmat[:3, :3]
    local = splats.means @ rotation.T + viewmat[:3, 3]
    ahead = local[:, 2] > NEAR
    z = torch.where(ahead, local[:, 2], 1.0)
    tall = local[:, 1] / z
    row = (K[1, 1] * tall + K[1, 2]) / height  # 0 at the top of the picture, 1 at its bottom
    within = row.clamp(-FRUSTUM_MARGIN, 1 + FRUSTUM_MARGIN)
    slope = (K[1, 1] / z / height * (ahead & (row == within)))[:, None] * (rotation[1] - tall[:, None] * rotation[2])
    rush = (slope * speeds).sum(1).detach()
    share = readout / (1 - (readout * rush).clamp(-RUSH, RUSH))
    times = torch.where(ahead, share * (within - 0.5), 0.0)
    sheared = speeds[:, :, None] * ((share[:, None] * slope)[:, None] @ splats.axes)
    there = move(splats, speeds, spin, time + times)
    return there._replace(axes=there.axes + sheared)

"""From Gaussians to one closed surface: depth drawn from all around, fused in a grid of distances, its zero meshed.

Distances are fused as by Curless and Levoy (1996, a truncated signed distance), and no picture may show the solid outside of
the person's outline. What no camera sees into is solid, so the surface is closed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter, label
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import grid_sample

from stages.avatar.cameras.pinhole import onto
from stages.avatar.rasterize import Camera
from stages.avatar.splats.compose import depths
from stages.avatar.splats.gaussians import Splats

CELL = 0.005  # m, of the grid
NEAR = 0.03  # m from a Gaussian: where distances are fused
REACH = 0.015  # m: how far behind a surface a picture knows what is there
UNSURE = 0.02  # m: where the depths behind a pixel deviate by more, it shows two surfaces
SKIN = 0.009  # m: how far Gaussians show beyond their middles, which is where their depth is; outlines hold it
OUTLINE = 0.4  # coverage of the outline: Gaussians were learned with a blur, and look wider in small pictures
SMOOTH = 0.7  # cells: sigma over which distances are smoothed
SEEN = 0.1  # opacity from which a Gaussian is looked at


class Shell(NamedTuple):
    """A triangle surface: `vertices` [V,3] m, `faces` [T,3], counter-clockwise from outside."""

    vertices: np.ndarray
    faces: np.ndarray


@torch.no_grad()
def fused(splats: Splats, cameras: Sequence[Camera], cell: float = CELL) -> Shell:
    """The surface of Gaussians as `cameras` see it, in a grid of `cell` m; an empty one where they show nothing solid."""
    seen = splats.means[splats.opacities > SEEN].numpy()
    if len(seen) == 0:
        return Shell(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    margin = NEAR + 2 * cell
    low = seen.min(0) - margin
    shape = tuple(int(n) for n in np.ceil((seen.max(0) + margin - low) / cell) + 1)
    free = np.ones(shape, bool)
    free[tuple(np.rint((seen - low) / cell).astype(int).T)] = False
    near = distance_transform_edt(free) * cell < NEAR
    rows = np.flatnonzero(near)
    points = low + cell * np.stack(np.unravel_index(rows, shape), 1)
    around, _ = label(~near)
    field = np.where(around == around[0, 0, 0], REACH, -REACH).astype(np.float32)
    field.reshape(-1)[rows] = _distances(torch.as_tensor(points).float(), splats, cameras).numpy()
    field = gaussian_filter(field, SMOOTH)
    if field.min() >= 0:
        return Shell(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    return Shell(low + cell * vertices, faces.astype(np.int64))


def _distances(points: Tensor, splats: Splats, cameras: Sequence[Camera]) -> Tensor:
    """Signed distances [P] m of points [P,3] from the surface, positive outside, no larger than REACH."""
    total, count = torch.zeros(len(points)), torch.zeros(len(points))
    beyond = torch.full((len(points),), -REACH)
    for camera in (camera.to(points) for camera in cameras):
        depth, variance, alpha = depths(splats, camera)
        sure = (alpha > OUTLINE) & (variance < UNSURE**2)
        local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        at = onto(local, camera.K)
        column, row = at.long().T
        pixel = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        ahead = depth.flatten()[pixel] - local[:, 2]
        known = sure.flatten()[pixel] & (ahead > -REACH)
        total += torch.where(known, ahead.clamp(max=REACH), 0)
        count += known
        unit = 2 * at / torch.tensor([camera.width, camera.height]) - 1
        covered = grid_sample(alpha[None, None], unit[None, None], align_corners=False)[0, 0, 0]
        beyond = torch.maximum(beyond, 2 * REACH * (OUTLINE - covered))
    return torch.maximum(torch.where(count > 0, total / count.clamp_min(1), -REACH) - SKIN, beyond)

"""The texture of a surface: pictures of the Gaussians from all around, laid on it, each where it looks at it most squarely."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import xatlas
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import grid_sample

from stages.avatar.cameras.pinhole import camera_centers, onto
from stages.avatar.drawing.cast import Moment
from stages.avatar.kernels.mesh import fill
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.avatar.surface.around import SOLID, around

GUTTER = 4  # texels between two charts
SQUARE = 12.0  # power of the cosine between sight and normal by which a picture counts
SLANTED = 0.2  # cosine under which it does not
BEHIND = 0.006  # m: what lies so far behind the surface that a picture shows is hidden there
LEAST = 1e-3  # of what all pictures of a texel count together: below it none shows it
GREY = 0.5


class Charts(NamedTuple):
    """A surface cut open and laid flat: `rows` [V] of the vertices before the cut, `faces` [T,3], `uvs` [V,2] in 0..1, from the
    picture's upper left corner."""

    rows: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray


def unwrapped(vertices: np.ndarray, faces: np.ndarray, side: int) -> Charts:
    """A surface of vertices [V,3] m and faces [T,3] laid flat in a picture `side` px square."""
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.resolution, pack.padding = side, GUTTER
    atlas.generate(xatlas.ChartOptions(), pack)
    rows, cut, uvs = atlas[0]
    return Charts(rows.astype(np.int64), cut.astype(np.int64), uvs.astype(np.float64))


@torch.no_grad()
def baked(
    charts: Charts, vertices: np.ndarray, normals: np.ndarray, splats: Splats, cameras: Sequence[Camera], side: int
) -> np.ndarray:
    """The texture [side,side,3] uint8 of a surface: its vertices [V,3] m and unit normals [V,3] after the cut.

    What no camera sees has the colours of the Gaussians around.
    """
    flat = np.concatenate([charts.uvs, np.ones((len(charts.uvs), 1))], 1)
    scale = np.diag([side, side, 1.0])
    _, face, weights = fill(flat, charts.faces, scale, side, side)
    on = face >= 0
    corners, shares = charts.faces[face[on]], weights[on][..., None]
    places, facing = (torch.as_tensor((part[corners] * shares).sum(1)).float() for part in (vertices, normals))
    total, count = torch.zeros(len(places), 3), torch.zeros(len(places))
    for camera in (camera.to(places) for camera in cameras):
        rows, colours, square = _seen(places, facing, charts.faces, vertices, splats, camera)
        total[rows] += square[:, None] * colours
        count[rows] += square
    colours = total / count.clamp_min(1e-9)[:, None]
    unseen = count < LEAST
    colours[unseen] = _around(places[unseen], splats)
    picture = np.full((side, side, 3), GREY, np.float32)
    picture[on] = colours.numpy()
    if not on.all() and on.any():
        picture = picture[tuple(distance_transform_edt(~on, return_distances=False, return_indices=True))]
    return np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)


def _seen(
    places: Tensor, facing: Tensor, faces: np.ndarray, vertices: np.ndarray, splats: Splats, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """The rows [S] of places [P,3] that a camera sees, their colours [S,3] there and how much they count [S]."""
    view, size = camera.viewmat.numpy(), (camera.width, camera.height)
    sight = torch.as_tensor(camera_centers(view)) - places
    cosine = (sight * facing).sum(1) / sight.norm(dim=1) / facing.norm(dim=1).clamp_min(1e-9)
    rows = (cosine > SLANTED).nonzero()[:, 0]
    image, alpha = map(torch.as_tensor, Moment([splats]).picture(camera))
    there = vertices @ view[:3, :3].T.astype(np.float64) + view[:3, 3]
    depth, _, _ = fill(there, faces, camera.K.numpy().astype(np.float64), *size)
    local = places[rows] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    at = onto(local, camera.K)
    column, row = at.long().T
    shown = torch.as_tensor(depth).float().clamp(max=1e6)[row, column] > local[:, 2] - BEHIND
    rows, unit = rows[shown], 2 * at[shown] / torch.tensor(size) - 1
    layers = torch.cat([image, alpha[..., None]], 2).permute(2, 0, 1)[None]
    found = grid_sample(layers, unit[None, None], align_corners=False)[0, :, 0].T
    colours, alpha = found[:, :3] / found[:, 3:].clamp_min(1e-6), found[:, 3]
    return rows, colours, alpha * cosine[rows] ** SQUARE


def _around(places: Tensor, splats: Splats) -> Tensor:
    """Mean colours [P,3] of the Gaussians around places [P,3] m; grey where there are none that are seen."""
    if len(places) == 0 or not (splats.opacities > SOLID).any():
        return torch.full((len(places), 3), GREY)
    rows, share = around(splats, places)
    colours = splats._replace(sh=splats.sh[:, :1]).colors(places.new_zeros(3)).clamp(0, 1)
    return (share[..., None] * colours[rows]).sum(1)

"""Where cloth and hair stand off the body: what the masks of many frames leave of the space around a body at rest.

A visual hull (Laurentini 1994), carved in the rest pose: the skeleton carries each point of a grid to every frame, with
skinning weights that spread from the skin into space. Where the body itself covers a point, a frame says nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import binary_closing, gaussian_filter, label, zoom
from scipy.spatial import cKDTree

from stages.avatar.splats.neighbours import farthest_points

REACH = 0.32  # m from the skin: as far as cloth is looked for
CELL = 0.025  # m, of the grid
SOURCES = 512  # patches of skin from which weights spread
CLOTH = 0.5  # share of the frames from one side that must have a point inside the mask
SIDES = 8  # directions of sight, by azimuth, in which a point must be inside: of two opposite ones either tells
EACH, SAY = 2.0, 4.0  # frames with a say: of a side that counts, and of all, at least
LOOKS = 1 / 16  # of all frames, that look from a side, at least
CLEAR = 0.03  # m off the skin from which a surface is cloth, not skin
LEAST = 30  # cells of a piece of cloth, at least
CLOSED = 3  # cells: half the width of gaps that are closed


class Space(NamedTuple):
    """Cells of a grid around a body at rest: `points` [P,3] m, their `rows` in the grid of `shape` from `origin` [3].

    `away` [P] m from the skin, negative inside; skinning `weights` [P,24], rows sum to 1.
    """

    points: np.ndarray
    rows: np.ndarray
    shape: tuple[int, ...]
    origin: np.ndarray
    away: np.ndarray
    weights: np.ndarray

    def grid(self, values: np.ndarray) -> np.ndarray:
        """Values [P] in the whole grid, 0 elsewhere."""
        whole = np.zeros(int(np.prod(self.shape)), values.dtype)
        whole[self.rows] = values
        return whole.reshape(self.shape)


class Cloth(NamedTuple):
    """A surface off the body at rest: `points` [C,3] m about `spacing` m apart and `away` [C] m from the skin.

    Outward unit `normals` [C,3], and skinning `weights` [C,24].
    """

    points: np.ndarray
    normals: np.ndarray
    weights: np.ndarray
    away: np.ndarray
    spacing: float


class Skin(NamedTuple):
    """The body at rest: `vertices` [V,3] m, unit `normals` [V,3], skinning `weights` [V,24]; what it knows of points around."""

    vertices: np.ndarray
    normals: np.ndarray
    weights: np.ndarray

    def away(self, points: np.ndarray, most: float = np.inf) -> np.ndarray:
        """Distances [P] m of points [P,3], negative inside; infinite beyond `most`."""
        distance, near = cKDTree(self.vertices).query(points, distance_upper_bound=most)
        known = np.isfinite(distance)
        out = ((points[known] - self.vertices[near[known]]) * self.normals[near[known]]).sum(1)
        distance[known] = np.where(out < 0, -distance[known], distance[known])
        return distance

    def spread(self, points: np.ndarray) -> np.ndarray:
        """Skinning weights [P,24] that spread from the skin into space: between two legs they are half of either's.

        A patch of skin counts by its size, over its distance cubed: as in a harmonic function over a plane.
        """
        centres = farthest_points(torch.from_numpy(self.vertices), SOURCES).numpy()
        _, owner = cKDTree(self.vertices[centres]).query(self.vertices)
        share = cKDTree(self.vertices).query(self.vertices, k=7)[0][:, 1:].mean(1) ** 2  # the area of a vertex
        mass = np.bincount(owner, share, len(centres))
        sources = np.stack([np.bincount(owner, share * w, len(centres)) for w in self.weights.T], 1)
        at = np.stack([np.bincount(owner, share * x, len(centres)) for x in self.vertices.T], 1) / mass[:, None]
        places, patches, sums = (torch.as_tensor(part, dtype=torch.float32) for part in (points, at, sources))
        found = []
        for some in places.split(8192):
            near = torch.cdist(some, patches, compute_mode="donot_use_mm_for_euclid_dist").clamp_min(0.5 * CELL)
            found.append((near * near * near).reciprocal() @ sums)
        spread = torch.cat(found).double().numpy() if found else np.zeros((0, self.weights.shape[1]))
        return spread / spread.sum(1, keepdims=True)


def space_around(skin: Skin) -> Space:
    """The cells within REACH of the skin, and those inside."""
    origin = skin.vertices.min(0) - REACH
    shape = tuple(int(n) for n in np.ceil((skin.vertices.max(0) + REACH - origin) / CELL) + 1)
    points = origin + CELL * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    away = skin.away(points, REACH)
    rows = np.flatnonzero(np.isfinite(away))
    return Space(points[rows], rows, shape, origin, away[rows], skin.spread(points[rows]))


class Sight(NamedTuple):
    """A frame: `bones` [24,4,4] from rest into the world, camera, and in its picture the `mask` [H,W] 0..1 and the `body` [H,W]."""

    bones: np.ndarray
    viewmat: np.ndarray
    K: np.ndarray
    mask: np.ndarray
    body: np.ndarray


class Carved(NamedTuple):
    """Which cells [P] are in `cloth`, and which `may` be: no side tells that they are empty, but too few frames tell."""

    cloth: np.ndarray
    may: np.ndarray


def carve(space: Space, sights: Iterable[Sight]) -> Carved:
    """Cloth is what is off the body, and inside the mask in most frames of every side that can tell.

    Most of all frames would not do: a point a fifth outside a round skirt is inside its outline from half of all sides. And
    from a few sides alone a body casts long shadows of itself to the front and the back: where frames look from no side
    within the width of two, nothing is cloth.
    """
    inside, outside, looked = np.zeros((3, SIDES, len(space.points)))
    frames = 0
    for sight in sights:
        frames += 1
        blend = (space.weights @ sight.bones[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        world = np.einsum("pab,pb->pa", blend[..., :3], space.points) + blend[..., 3]
        local = world @ sight.viewmat[:3, :3].T + sight.viewmat[:3, 3]
        at = np.floor(local[:, :2] / np.maximum(local[:, 2:], 1e-3) * np.diag(sight.K)[:2] + sight.K[:2, 2])
        height, width = sight.mask.shape
        shown = (local[:, 2] > 0.05) & (at >= 0).all(1) & (at < [width, height]).all(1)
        column, row = at[shown].astype(int).T
        eye = -sight.viewmat[:3, :3].T @ sight.viewmat[:3, 3]
        ray = np.einsum("pba,pb->pa", blend[shown, :, :3], world[shown] - eye)
        side = np.floor(np.arctan2(ray[:, 0], ray[:, 2]) / np.pi * SIDES).astype(int) % SIDES
        looked[side, shown] += 1
        tells = ~sight.body[row, column]
        seen, side, value = np.flatnonzero(shown)[tells], side[tells], sight.mask[row[tells], column[tells]]
        inside[side, seen] += value
        outside[side, seen] += 1 - value
    say, unseen = inside + outside, looked < LOOKS * frames
    blind = (unseen & np.roll(unseen, 1, 0)).any(0)
    held = (inside > CLOTH * say) | (say < EACH)
    may = (space.away > 0) & held.all(0) & ~(inside.sum(0) < CLOTH * say.sum(0))
    found = may & (say.sum(0) >= SAY) & ~blind
    pieces, _ = label(space.grid(found) | space.grid(space.away <= 0))
    large = np.bincount(pieces[space.grid(found)], minlength=pieces.max() + 1) >= LEAST
    return Carved(found & large[pieces.ravel()[space.rows]], may)


def surface(space: Space, skin: Skin, carved: Carved, spacing: float) -> Cloth:
    """The outside of cloth where it is off the skin, as points about `spacing` m apart.

    Gaps of a few cells that nobody sees into, as between the thighs under a skirt, are closed.
    """
    solid = space.grid(carved.cloth | (space.away <= 0))
    solid |= binary_closing(solid, iterations=CLOSED) & space.grid(carved.may)
    around, _ = label(~solid)
    solid = around != around[0, 0, 0]  # what is closed in is solid too
    finer = max(1, round(CELL / spacing))
    field = gaussian_filter(solid.astype(np.float64), 1.0)
    if finer > 1:
        field = zoom(field, finer, order=1, mode="nearest", grid_mode=False)
    step = np.array([CELL * (n - 1) / (m - 1) for n, m in zip(space.shape, field.shape)])
    full = field >= 0.5
    rim = np.zeros_like(full)
    for axis in range(3):
        for by in (1, -1):
            rim |= full & ~np.roll(full, by, axis)
    slope = np.stack(np.gradient(field, *step), -1)[rim]
    steep = np.linalg.norm(slope, axis=1, keepdims=True).clip(1e-9)
    normals = -slope / steep
    points = space.origin + step * np.argwhere(rim) + normals * ((field[rim] - 0.5)[:, None] / steep).clip(-CELL, CELL)
    away = skin.away(points)
    off = away > CLEAR
    return Cloth(points[off], normals[off], skin.spread(points[off]), away[off], float(step.mean()))

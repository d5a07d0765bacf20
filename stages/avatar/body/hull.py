"""Where cloth and hair stand off the body: what the masks of many frames leave of the space around a body at rest.

A visual hull (Laurentini 1994), carved in the rest pose: the skeleton carries each point of a grid to every frame, with
skinning weights that spread from the skin into space. Where the body itself covers a point, a frame shows nothing of it.
Nor does a mask that fills a narrow gap between two limbs: a thigh that never leaves the other is no skirt. Cloth stands
further off the body's outline than errors of a body fit and the thickness of shirt and trousers explain (FAR); around such a
piece all that the masks hold is cloth.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter, label, zoom
from scipy.spatial import cKDTree

from stages.avatar.body.joints import ANKLES, ELBOWS, FEET, HANDS, HIPS, KNEES, SHOULDERS, WRISTS
from stages.avatar.cameras.pinhole import camera_centers, onto
from stages.avatar.splats.neighbours import farthest_points

REACH = 0.32  # m from the skin: as far as cloth is looked for
CELL = 0.025  # m, of the grid
SOURCES = 512  # patches of skin from which weights spread
CLOTH = 0.5  # share of the frames from one side that must have a point inside the mask
SIDES = 8  # directions of sight, by azimuth, in which a point must be inside: of two opposite ones either tells
EACH, SAY = 2.0, 4.0  # frames that show a point: of a side that counts, and of all, at least
LOOKS = 1 / 16  # of all frames, that look from a side, at least
CLEAR = 0.03  # m off the skin from which a surface is cloth, not skin
FAR = 0.03  # m off the body's outline: what never shows so far off is shirt, trousers or an error of the fit
NEAREST = 0.3  # m from the camera: nearer bodies show gaps as if they were here
GAP = 0.06  # m: half the width of gaps between limbs that show no cloth
LIMBS = *zip(HIPS, KNEES, ANKLES, FEET), *zip(SHOULDERS, ELBOWS, WRISTS, HANDS)
ONE_LIMB = 0.7  # of the skinning weights of a piece of cloth: so much of one limb is of it alone
LEAST = 10  # cells of a piece of cloth that show FAR off the body, at least
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
    """Which cells [P] are in `cloth`, which of them show `far` off the body, and which `may` be cloth: no side shows that they
    are empty, but too few frames show them.
    """

    cloth: np.ndarray
    far: np.ndarray
    may: np.ndarray

    def volume(self, space: Space) -> float:
        """The volume of cloth that is CLEAR of the skin, as share of the body's."""
        return float((self.cloth & (space.away > CLEAR)).sum() / (space.away <= 0).sum())


def carve(space: Space, sights: Iterable[Sight]) -> Carved:
    """Cloth is what is off the body, and inside the mask in most frames of every side that shows it.

    Most of all frames would not do: a point a fifth outside a round skirt is inside its outline from half of all sides. And
    from a few sides alone a body casts long shadows of itself to the front and the back: where frames look from no side
    within the width of two, nothing is cloth. A piece of cloth has LEAST cells that show FAR off the body.
    """
    inside = np.zeros((2, SIDES, len(space.points)))  # beyond gaps between limbs, and FAR off the body
    outside, looked = np.zeros((2, SIDES, len(space.points)))
    bare, frames = np.zeros(len(space.points)), 0
    for sight in sights:
        frames += 1
        rows, side, pixel, metre = _seen(space, sight)
        looked[side, rows] += 1
        off = ~sight.body[pixel]
        rows, side, pixel = rows[off], side[off], tuple(part[off] for part in pixel)
        value = sight.mask[pixel]
        outside[side, rows] += 1 - value
        bare[rows] += 1
        for level, free in zip(inside, beyond(sight.body, GAP * metre, FAR * metre)):
            level[side, rows] += value * free[pixel]
    unseen = looked < LOOKS * frames
    blind = (unseen & np.roll(unseen, 1, 0)).any(0)
    known = (bare >= SAY) & ~blind
    may, far = (_may(one, outside) for one in inside)
    found, far = known & may & (inside[0].sum(0) >= EACH), known & far & (inside[1].sum(0) >= SAY)
    out = space.away > 0
    pieces, _ = label(space.grid(found & (space.away > CLEAR)))
    piece = pieces.ravel()[space.rows]
    large = np.bincount(piece[far & out], minlength=pieces.max() + 1) >= LEAST
    large[0] = False
    for k in np.flatnonzero(large):
        large[k] = not around_a_limb(space, piece == k)
    cloth = found & out & (large[piece] | (space.away <= CLEAR)) & large.any()
    return Carved(cloth, far & cloth & (space.away > CLEAR), may & out)


def around_a_limb(space: Space, piece: np.ndarray) -> bool:
    """Whether a piece, cells [P], is a tube around one leg or arm, such as a wide trouser leg: it goes with its limb, as skin does.

    A bag beside a leg has its middle in itself, a skirt is around both legs.
    """
    points, carried = space.points[piece], space.weights[piece].mean(0)
    middle = np.linalg.norm(space.points - points.mean(0), axis=1).argmin()
    return max(carried[list(limb)].sum() for limb in LIMBS) > ONE_LIMB and space.away[middle] <= 0


def _seen(space: Space, sight: Sight) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...], float]:
    """The cells [S] that a frame shows, the side [S] that it sees them from, their pixels, row and column, and a metre in px."""
    blend = (space.weights @ sight.bones[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
    world = np.einsum("pab,pb->pa", blend[..., :3], space.points) + blend[..., 3]
    local = world @ sight.viewmat[:3, :3].T + sight.viewmat[:3, 3]
    at = np.floor(onto(local, sight.K, 1e-3))
    height, width = sight.mask.shape
    shown = (local[:, 2] > 0.05) & (at >= 0).all(1) & (at < [width, height]).all(1)
    column, row = at[shown].astype(int).T
    ray = np.einsum("pba,pb->pa", blend[shown, :, :3], world[shown] - camera_centers(sight.viewmat))
    side = np.floor(np.arctan2(ray[:, 0], ray[:, 2]) / np.pi * SIDES).astype(int) % SIDES
    metre = sight.K[0, 0] / max(float(np.median(local[:, 2])), NEAREST)
    return np.flatnonzero(shown), side, (row, column), metre


def beyond(body: np.ndarray, gap: float, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [H,W] off a silhouette [H,W] whose gaps of up to twice `gap` px are closed, and those `margin` px off it as well."""
    free = np.ones_like(body), np.ones_like(body)
    if not body.any():
        return free
    rows, columns = (np.flatnonzero(body.any(axis)) for axis in (1, 0))
    box, pad = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], int(gap + margin) + 2
    away = distance_transform_edt(~np.pad(body[box], pad))
    top, left = rows[0] - pad, columns[0] - pad
    for shown, grow in zip(free, (0.0, margin)):
        near = distance_transform_edt(away <= gap + grow) > gap
        near = near[max(0, -top) :, max(0, -left) :]
        place = shown[max(0, top) :, max(0, left) :][: near.shape[0], : near.shape[1]]
        place &= ~near[: place.shape[0], : place.shape[1]]
    return free


def _may(inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Which points [P] no side, and not all together, show to be empty, by what they show [SIDES,P]."""
    shown = inside + outside
    return ((inside > CLOTH * shown) | (shown < EACH)).all(0) & ~(inside.sum(0) < CLOTH * shown.sum(0))


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

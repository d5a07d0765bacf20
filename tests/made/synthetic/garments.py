"""Skirt, coat, ponytail and bag of the person of a synthetic clip: what swings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from stages.avatar.body.joints import HEAD
from stages.records import BodyModel
from tests.made.synthetic.cloth import MARGIN, Particles

AROUND = 40
"""Particles around a skirt or a coat."""
TRUNK = 0.2
"""m from the middle to which the trunk reaches at rest: beyond are arms."""
Paint = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Garment:
    """A mesh of `cloth`'s particles with `faces` [T,3]; its corners are at `chart` [T,3,2] m, and `paint` gives colours
    [N,3] 0..1 of places [N,2] m there."""

    cloth: Particles
    faces: np.ndarray
    chart: np.ndarray
    paint: Paint


class DressedBody:
    """The body at rest that clothes are cut for."""

    def __init__(self, model: BodyModel, betas: np.ndarray):
        self.vertices = model.v_template + model.shapedirs @ betas
        self.weights = np.asarray(model.lbs_weights, np.float64)
        if model.keypoint_regressor is None or model.keypoint_names is None:
            raise ValueError(f"the body model {model.name!r} has no keypoints, which clothes are cut by")
        self.at = dict(zip(model.keypoint_names, model.keypoint_regressor @ self.vertices))
        self.faces = np.asarray(model.faces)
        self.near = cKDTree(self.vertices)

    def carriers(self, places: np.ndarray) -> np.ndarray:
        """Skinning weights [G,24] of the skin nearest to `places` [G,3]."""
        return self.weights[self.near.query(places)[1]]

    def girth(self, y: float, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Middle [2] (x, z) of the trunk at a height, and how far its skin reaches [A] at `angles` about it."""
        band = self.vertices[(abs(self.vertices[:, 1] - y) < 0.03) & (abs(self.vertices[:, 0]) < TRUNK)][:, [0, 2]]
        middle = (band.min(0) + band.max(0)) / 2
        ways = np.stack([np.sin(angles), np.cos(angles)], 1)
        return middle, ((band - middle) @ ways.T).max(0)


def grid(rows: int, columns: int, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Faces [T,3] and rods [R,2] of a grid of particles, its columns a ring if `closed`."""
    index = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(index, -1, 1) if closed else index
    across = (index, right) if closed else (index[:, :-1], index[:, 1:])
    a, b, c, d = across[0][:-1], across[1][:-1], across[0][1:], across[1][1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    pairs = [across, (index[:-1], index[1:]), (a, d), (b, c)]
    return faces, np.concatenate([np.stack(pair, -1).reshape(-1, 2) for pair in pairs])


def _sheet(
    body: DressedBody,
    top: float,
    hem: float,
    held: float,
    flare: float,
    angles: np.ndarray,
    rows: int,
    stiff: float,
    ease: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [R,A,3] of cloth from `top` to `hem` that lies on the trunk down to `held` and then widens by `flare` a metre.

    And which are pinned, and the stiffness, both [R,A].
    """
    heights, reach = np.linspace(top, hem, rows), np.zeros(len(angles))
    places: list[np.ndarray] = []
    for y in heights:
        if y >= held or not places:
            middle, girth = body.girth(y, angles)
            reach = np.maximum(girth + ease, reach) if y < top - 0.25 else girth + ease
            bottom = y
        radius = reach + flare * (bottom - y) * (1 + 0.12 * np.cos(7 * angles))
        ring = middle + radius[:, None] * np.stack([np.sin(angles), np.cos(angles)], 1)
        places.append(np.stack([ring[:, 0], np.full(len(angles), y), ring[:, 1]], 1))
    pinned = np.repeat((heights >= held - 1e-9)[:, None], len(angles), 1)
    return np.stack(places), pinned, np.full(pinned.shape, stiff)


def skirt(body: DressedBody, rng: np.random.Generator) -> Garment:
    """A flared skirt from the waist to below the knees, in checks or dots, that hangs from the pelvis."""
    waist, hem = body.at["left_hip"][1] + 0.07, body.at["left_knee"][1] - rng.uniform(0.0, 0.12)
    angles = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    rows = 14
    places, pinned, stiff = _sheet(body, waist, hem, waist - 0.045, rng.uniform(0.38, 0.55), angles, rows, 25.0, 0.02)
    faces, rods = grid(rows, AROUND, closed=True)
    chart = np.stack(np.broadcast_arrays(0.28 * angles, (waist - places[..., 1])), -1)
    return _made(body, places, pinned, stiff, rods, faces, chart, pattern(rng), 0, 0.28 * 2 * np.pi)


def coat(body: DressedBody, rng: np.random.Generator) -> Garment:
    """A long coat without sleeves, open in front, that lies on the trunk and hangs free below the hips."""
    top, hem = body.at["left_shoulder"][1] - 0.11, body.at["left_knee"][1] - rng.uniform(0.1, 0.2)
    gap = rng.uniform(0.2, 0.35)
    angles, rows = np.linspace(gap, 2 * np.pi - gap, AROUND), 22
    held = body.at["left_hip"][1] + 0.02
    places, pinned, stiff = _sheet(body, top, hem, held, rng.uniform(0.2, 0.3), angles, rows, 12.0, 0.025)
    faces, rods = grid(rows, AROUND, closed=False)
    chart = np.stack(np.broadcast_arrays(0.25 * angles, top - places[..., 1]), -1)
    return _made(body, places, pinned, stiff, rods, faces, chart, pattern(rng), 0)


def ponytail(body: DressedBody, rng: np.random.Generator) -> Garment:
    """Hair tied at the back of the head, a tapering tube that hangs down the neck."""
    head = body.vertices[body.weights[:, HEAD] > 0.5]
    height = body.at["left_eye"][1] + 0.03
    level = head[abs(head[:, 1] - height) < 0.03]
    tie = np.array([0.0, height, level[:, 2].min()])
    length, rows, columns = rng.uniform(0.3, 0.42), 12, 8
    along = np.linspace(-0.1, 1, rows)
    middle = tie + np.stack([0 * along, -length * along.clip(0) ** 1.5, -0.12 * along.clip(max=0.5) * 2 / 2], 1)
    turn = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    thick = np.interp(along, [-0.1, 0.05, 0.4, 1], [0.025, 0.022, 0.042, 0.012])
    ways = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1)
    places = middle[:, None] + thick[:, None, None] * ways
    pinned = np.repeat((along < 0.05)[:, None], columns, 1)
    faces, rods = grid(rows, columns, closed=True)
    index = np.arange(rows * columns).reshape(rows, columns)
    struts = [np.stack([index, np.roll(index, s, 1)], -1).reshape(-1, 2) for s in (2, 3, 4)]
    second = np.stack([index[:-2], index[2:]], -1).reshape(-1, 2)
    chart = np.stack(np.broadcast_arrays(0.04 * turn, length * along[:, None]), -1)
    shade = np.array([0.32, 0.17, 0.09]) * rng.uniform(0.8, 1.6)

    def hair(at: np.ndarray) -> np.ndarray:
        streaks = 1 + 0.3 * np.sin(260 * at[:, :1] + 4 * np.sin(30 * at[:, 1:]))
        return np.where((at[:, 1:] > 0.01) & (at[:, 1:] < 0.035), [0.8, 0.2, 0.3], shade * streaks)

    rods = np.concatenate([rods, *struts, second])
    return _made(body, places, pinned, np.full(pinned.shape, 8.0), rods, faces, chart, hair, HEAD, 0.04 * 2 * np.pi)


def bag(body: DressedBody, rng: np.random.Generator) -> Garment:
    """A bag at the left hip on a strap over the right shoulder."""
    width, tall, deep = rng.uniform(0.24, 0.3), rng.uniform(0.18, 0.24), 0.09
    hip = body.at["left_hip"]
    side = body.vertices[(abs(body.vertices[:, 1] - hip[1]) < 0.05) & (abs(body.vertices[:, 0]) < 0.3), 0].max()
    middle = np.array([side + 0.03 + deep / 2, hip[1] - 0.06, 0.0])
    # the box: rings of 12 around z and x, six rows down
    ring = np.array([(x, z) for x, z in _outline(deep, width, 3, 5)])
    rows, columns = 6, len(ring)
    levels = np.linspace(tall / 2, -tall / 2, rows)
    box = np.stack([np.stack([ring[:, 0], np.full(columns, y), ring[:, 1]], 1) for y in levels]) + middle
    faces, rods = grid(rows, columns, closed=True)
    index = np.arange(rows * columns).reshape(rows, columns)
    lids = np.concatenate([_fan(index[0][::-1]), _fan(index[-1])])
    corners = index[::5, :].ravel()
    stiff_rods = np.stack(np.triu_indices(len(corners), 1), 1)
    braces = np.concatenate([corners[stiff_rods], np.stack([index[:-2], index[2:]], -1).reshape(-1, 2)])
    # the strap: from the box's front edge over the right shoulder to its back edge
    shoulder = body.at["right_shoulder"] + [0.05, 0.0, 0.0]
    top = body.vertices[np.linalg.norm(body.vertices[:, [0, 2]] - shoulder[[0, 2]], axis=1) < 0.03]
    peak = np.array([shoulder[0], top[:, 1].max() + MARGIN, shoulder[2]])
    steps = 13
    front, back = (middle + [0, tall / 2, s * width / 2] for s in (1, -1))
    share = np.linspace(0, 1, steps)[:, None]
    bulge = 0.16 * np.sin(np.pi * share) * [0.0, 0.0, 1.0]
    way = np.concatenate([front * (1 - share) + peak * share + bulge, (peak * (1 - share) + back * share - bulge)[1:]])
    strap = np.stack([way + [0, 0.0, 0], way + [0.03, 0.012, 0.0]], 1)
    more_faces, more_rods = grid(len(way), 2, closed=False)
    start = box.size // 3
    ends = [(start, index[0, abs(ring - [0, width / 2]).sum(1).argmin()]),
            (start + 2 * len(way) - 2, index[0, abs(ring - [0, -width / 2]).sum(1).argmin()])]  # fmt: skip
    ties = np.array([(strap_end + i, box_end) for strap_end, box_end in ends for i in (0, 1)])
    places = np.concatenate([box.reshape(-1, 3), strap.reshape(-1, 3)])
    pinned = np.zeros(len(places), bool)
    pinned[start + 2 * (steps - 2) : start + 2 * (steps + 1)] = True
    rods = np.concatenate([rods, braces, more_rods + start, ties])
    faces = np.concatenate([faces, lids, more_faces + start])
    chart = np.concatenate([np.stack([places[:start, 2] + places[:start, 0], places[:start, 1]], 1),
                            np.full((len(places) - start, 2), 9.0)])  # fmt: skip
    cover = pattern(rng)

    def paint(at: np.ndarray) -> np.ndarray:
        return np.where(at[:, :1] > 8.0, [0.2, 0.12, 0.07], cover(at))

    return _made(body, places, pinned, np.full(len(places), 3.0), rods, faces, chart, paint, 0)


def _outline(deep: float, wide: float, few: int, many: int) -> list[tuple[float, float]]:
    """Points on a rectangle's outline, counter-clockwise seen from above (x right, z towards the viewer)."""
    x, z = np.linspace(-deep / 2, deep / 2, few), np.linspace(-wide / 2, wide / 2, many)
    sides = [(x[-1], t) for t in z[::-1]], [(t, z[0]) for t in x[::-1][1:]], [(x[0], t) for t in z[1:]]
    return [*sides[0], *sides[1], *sides[2], *[(t, z[-1]) for t in x[1:-1]]]


def _fan(ring: np.ndarray) -> np.ndarray:
    return np.stack([np.full(len(ring) - 2, ring[0]), ring[1:-1], ring[2:]], 1)


def _made(
    body: DressedBody, places: np.ndarray, pinned: np.ndarray, stiff: np.ndarray, rods: np.ndarray, faces: np.ndarray,
    chart: np.ndarray, paint: Paint, hangs: int, closed: float = np.inf,
) -> Garment:  # fmt: skip
    """Pinned particles go with the skin beneath, the others are pulled to where joint `hangs` would carry them.

    `chart` is that of particles; around a ring that is `closed` m long it has a seam.
    """
    places, pinned, stiff = places.reshape(-1, 3), pinned.ravel(), stiff.ravel()
    weights = np.zeros((len(places), body.weights.shape[1]))
    weights[:, hangs] = 1
    weights[pinned] = body.carriers(places[pinned])
    cloth = Particles(places, weights, pinned, stiff, np.unique(np.sort(rods, 1), axis=0))
    corners = chart.reshape(-1, 2)[faces]
    behind = corners[..., 0].max(1, keepdims=True) - corners[..., 0] > closed / 2
    corners[behind, 0] += closed
    return Garment(cloth, faces, corners, paint)


def pattern(rng: np.random.Generator) -> Paint:
    """Checks, dots or stripes of 5 to 8 cm in three colours by chance."""
    inks, size, kind = rng.uniform(0.1, 0.95, (3, 3)), rng.uniform(0.09, 0.14), rng.integers(3)

    def paint(at: np.ndarray) -> np.ndarray:
        u, v = (at / size).T
        dots = 0.33 - np.hypot(u - np.round(u), v - np.round(v))
        checks = np.sin(2 * np.pi * u) * np.sin(2 * np.pi * v)
        stripes = np.sin(2 * np.pi * v) - 0.2
        inside = (dots * 8, checks * 3, stripes * 3)[kind]
        cover = (inside + 0.5).clip(0, 1)[:, None]
        band = (abs(v - np.round(v / 3) * 3) < 0.18)[:, None]
        return np.where(band, inks[2], inks[0] * (1 - cover) + inks[1] * cover)

    return paint

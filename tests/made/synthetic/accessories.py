"""What a person wears on head, neck, arms, back and feet that stands off the body, most of it stiff."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from stages.avatar.body.joints import ANKLES, FEET, HEAD, KNEES
from stages.avatar.body.smpl import vertex_normals
from stages.records import JOINT_NAMES
from tests.made.synthetic.cloth import Particles
from tests.made.synthetic.garments import DressedBody, Garment, Paint, grid, pattern

CHEST = JOINT_NAMES.index("spine3")
NO_RODS = np.empty((0, 2), np.int64)
RING = 32


def _plain(rng: np.random.Generator) -> Paint:
    """One colour by chance with darker bands of 4 cm."""
    ink = rng.uniform(0.15, 0.9, 3)
    return lambda at: ink * np.where(np.sin(2 * np.pi * at[:, 1:] / 0.08) > 0, 1.0, 0.7)


def _on(joint: int, count: int) -> np.ndarray:
    """Skinning weights [count,24] of what one joint carries."""
    weights = np.zeros((count, len(JOINT_NAMES)))
    weights[:, joint] = 1
    return weights


def _worn(
    rings: np.ndarray, weights: np.ndarray, paint: Paint, free: np.ndarray | None = None, closed: bool = True
) -> Garment:
    """Rows of particles `rings` [R,A,3] that `weights` [R*A,24] carry, their columns rings if `closed`; `free` [R,A] swing."""
    rows, columns, _ = rings.shape
    faces, rods = grid(rows, columns, closed)
    places = rings.reshape(-1, 3)
    pinned = np.ones(len(places), bool) if free is None else ~free.ravel()
    steps = np.linalg.norm(np.diff(rings, axis=0), axis=2).mean(1)
    down = np.repeat(np.concatenate([[0], steps.cumsum()]), columns)
    chart = np.stack([np.tile(np.arange(columns) * 0.02, rows), down], 1)[faces]
    rods = NO_RODS if free is None else np.unique(np.sort(rods, 1), axis=0)
    return Garment(Particles(places, weights, pinned, np.full(len(places), 12.0), rods), faces, chart, paint)


def _ellipses(heights: np.ndarray, across: np.ndarray, along: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Level rings [R,RING,3] about `middle` [2] (x, z) with half axes `across` and `along` [R] m."""
    turn = np.linspace(0, 2 * np.pi, RING, endpoint=False)
    x = middle[0] + across[:, None] * np.sin(turn)
    z = middle[1] + along[:, None] * np.cos(turn)
    return np.stack([x, np.broadcast_to(heights[:, None], x.shape), z], 2)


def _skull(body: DressedBody) -> tuple[float, np.ndarray, np.ndarray]:
    """The height of the forehead, and the head's middle and half axes (x, z) there, m."""
    forehead = body.at["left_eye"][1] + 0.035
    head = body.vertices[(body.weights[:, HEAD] > 0.5) & (abs(body.vertices[:, 1] - forehead) < 0.02)][:, [0, 2]]
    return forehead, (head.min(0) + head.max(0)) / 2, (head.max(0) - head.min(0)) / 2


def _hat(body: DressedBody, rng: np.random.Generator) -> Garment:
    """A hat with a brim all around."""
    forehead, middle, half = _skull(body)
    crown = body.vertices[:, 1].max() + rng.uniform(0.02, 0.05)
    brim = rng.uniform(0.06, 0.09)
    heights = np.array([forehead - 0.012, forehead, crown - 0.02, crown, crown])
    off = np.array([brim, 0.012, 0.008, -0.02, -half.min() + 1e-3])
    rings = _ellipses(heights, half[0] + off, half[1] + off, middle)
    return _worn(rings, _on(HEAD, rings[..., 0].size), _plain(rng))


def _hair(body: DressedBody, rng: np.random.Generator) -> Garment:
    """Long open hair that falls from the crown over neck and back and swings below the ears."""
    forehead, middle, half = _skull(body)
    end = forehead - rng.uniform(0.3, 0.36)
    heights = np.concatenate([[body.vertices[:, 1].max() + 0.012], np.linspace(forehead + 0.03, end, 12)])
    turn = np.pi + np.linspace(-1.35, 1.35, 20)
    level = body.at["left_shoulder"][1] + 0.06
    reach = np.zeros((len(heights), len(turn)))
    for row, y in enumerate(heights[1:], 1):
        reach[row] = np.hypot(half[0] * np.sin(turn), half[1] * np.cos(turn)) + 0.018
        if y < level:  # it lies on the back
            trunk, girth = body.girth(y, np.array([np.pi]))
            behind = (middle[1] - trunk[1] + girth[0] + 0.02) / np.cos(turn - np.pi).clip(0.6)
            reach[row] = np.maximum(reach[row - 1], behind.clip(max=reach[row] + 0.1))
    reach[0] = 0.03
    x, z = middle[0] + reach * np.sin(turn), middle[1] + reach * np.cos(turn)
    rings = np.stack([x, np.broadcast_to(heights[:, None], x.shape), z], 2)
    free = np.repeat((heights < body.at["left_ear"][1])[:, None], len(turn), 1)
    shade = np.array([0.45, 0.28, 0.12]) * rng.uniform(0.6, 1.6)

    def hair(at: np.ndarray) -> np.ndarray:
        return shade * (1 + 0.3 * np.sin(300 * at[:, :1]))

    return _worn(rings, _on(HEAD, x.size), hair, free, closed=False)


def _hood(body: DressedBody, rng: np.random.Generator) -> Garment:
    """A hood that lies on the back below the neck."""
    y = body.at["left_shoulder"][1] + 0.02
    middle, reach = body.girth(y, np.array([np.pi]))
    centre = np.array([0, y - 0.01, middle[1] - reach[0] - 0.03])
    size = np.array([0.12, rng.uniform(0.09, 0.12), rng.uniform(0.05, 0.07)])
    lift, turn = np.linspace(-1.5, 1.5, 9), np.linspace(0, 2 * np.pi, RING, endpoint=False)
    unit = np.stack(np.broadcast_arrays(
        np.cos(lift)[:, None] * np.sin(turn), np.sin(lift)[:, None], np.cos(lift)[:, None] * np.cos(turn)), 2)  # fmt: skip
    return _worn(centre + size * unit, _on(CHEST, unit[..., 0].size), _plain(rng))


def _scarf(body: DressedBody, rng: np.random.Generator) -> Garment:
    """A scarf around the neck with an end that hangs down in front."""
    y, columns = body.at["left_shoulder"][1] + 0.055, 12
    neck = body.vertices[(abs(body.vertices[:, 1] - y) < 0.015) & (abs(body.vertices[:, 0]) < 0.09)][:, [0, 2]]
    middle, half = (neck.min(0) + neck.max(0)) / 2, (neck.max(0) - neck.min(0)) / 2
    thick = rng.uniform(0.026, 0.034)
    around, tube = np.linspace(0, 2 * np.pi, RING + 1), np.linspace(0, 2 * np.pi, columns, endpoint=False)
    out = half.max() + thick + thick * np.cos(tube)
    loop = np.stack(np.broadcast_arrays(
        middle[0] + np.sin(around)[:, None] * out,
        y + 1.3 * thick * np.sin(tube),
        middle[1] + np.cos(around)[:, None] * out), 2)  # fmt: skip
    knot, length = loop[0].mean(0) + [0.03, 0, 0.02], rng.uniform(0.3, 0.4)
    down = np.linspace(0, 1, 12)[:, None]
    front = np.array([np.cos(tube) * 0.05, 0 * tube, 0.012 * np.sin(tube)]).T
    ahead = body.vertices[(abs(body.vertices[:, 0]) < 0.1) & (body.vertices[:, 1] < y)]
    rows = knot - [0, length, 0] * down
    rows[:, 2] = [max(knot[2], 0.035 + ahead[abs(ahead[:, 1] - at) < 0.03, 2].max()) for at in rows[:, 1]]
    rings = np.concatenate([loop, rows[:, None] + front])
    free = np.zeros(rings.shape[:2], bool)
    free[len(loop) + 2 :] = True
    return _worn(rings, _on(CHEST, free.size), _plain(rng), free)


def _sleeves(body: DressedBody, rng: np.random.Generator) -> Garment:
    """Sleeves that widen to the wrists and hang below the forearms."""
    turn, rows, parts = np.linspace(0, 2 * np.pi, 16, endpoint=False), np.linspace(0, 1, 10), []
    deep = rng.uniform(0.1, 0.15)
    for side in ("left", "right"):
        arm = [body.at[f"{side}_{joint}"] for joint in ("shoulder", "elbow", "wrist")]
        begin = arm[0] + 0.55 * (arm[1] - arm[0])
        middle = begin + rows[:, None] * (arm[2] - 0.1 * (arm[2] - arm[1]) - begin)
        low = 0.065 + deep * rows[:, None] * (np.cos(turn) < 0)
        ring = np.stack(np.broadcast_arrays(0 * turn, low * np.cos(turn), 0.065 * np.sin(turn)), 2)
        parts.append(middle[:, None] + ring)
    pair = [_sleeve(part, body, turn) for part in parts]
    count = parts[0][..., 0].size
    cloth = Particles(*map(np.concatenate, zip(*(_arrays(one.cloth, i * count) for i, one in enumerate(pair)))))
    faces = np.concatenate([one.faces + i * count for i, one in enumerate(pair)])
    return Garment(cloth, faces, np.concatenate([one.chart for one in pair]), pattern(rng))


def _sleeve(rings: np.ndarray, body: DressedBody, turn: np.ndarray) -> Garment:
    """One sleeve: the arm's skin beneath carries it, what hangs swings."""
    free = np.linspace(0, 1, len(rings))[:, None] * (np.cos(turn) < -0.1) > 0.3
    return _worn(rings, body.carriers(rings.reshape(-1, 3)), lambda at: at, free)


def _arrays(cloth: Particles, first: int) -> tuple[np.ndarray, ...]:
    """The particles' arrays, numbered from `first`."""
    return cloth.places, cloth.weights, cloth.pinned, cloth.stiffness, cloth.rods + first


def _rucksack(body: DressedBody, rng: np.random.Generator) -> Garment:
    """A rucksack on the back."""
    top, deep, wide = body.at["left_shoulder"][1] - 0.02, rng.uniform(0.12, 0.18), rng.uniform(0.26, 0.32)
    tall = rng.uniform(0.36, 0.44)
    back = min(
        middle[1] - reach[0] for y in (top - 0.05, top - 0.2) for middle, reach in [body.girth(y, np.array([np.pi]))]
    )
    heights = top - tall * np.array([0, 0, 0.08, 0.5, 0.95, 1, 1])
    size = np.array([0.01, 0.8, 1, 1.05, 1.05, 0.9, 0.01])
    turn = np.linspace(0, 2 * np.pi, RING, endpoint=False)
    square = np.abs(np.stack([np.sin(turn), np.cos(turn)])) ** 0.5 * np.sign(np.stack([np.sin(turn), np.cos(turn)]))
    x, z = size[:, None] * wide / 2 * square[0], back - 0.02 - deep / 2 + size[:, None] * deep / 2 * square[1]
    rings = np.stack([x, np.broadcast_to(heights[:, None], x.shape), z], 2)
    return _worn(rings, _on(CHEST, x.size), pattern(rng))


def _boots(body: DressedBody, rng: np.random.Generator) -> Garment:
    """Boots whose shafts stand off the shins: the skin of feet and shins, moved out."""
    ankle, knee = body.at["left_ankle"][1], body.at["left_knee"][1]
    top = ankle + rng.uniform(0.5, 0.7) * (knee - ankle)
    legs = body.weights[:, [*KNEES, *ANKLES, *FEET]].sum(1) > 0.5
    faces = body.faces[(legs & (body.vertices[:, 1] < top))[body.faces].all(1)]
    rows, faces = np.unique(faces, return_inverse=True)
    normals = vertex_normals(torch.from_numpy(body.vertices), torch.from_numpy(body.faces.astype(np.int64))).numpy()[
        rows
    ]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    level = body.vertices[rows, 1]
    off = np.interp(level, [ankle - 0.05, ankle + 0.05, top], [0.012, 0.03, 0.05])
    places = body.vertices[rows] + off[:, None] * normals
    places[:, 1] = np.maximum(places[:, 1], body.vertices[:, 1].min())
    worn = Particles(places, body.weights[rows], np.ones(len(rows), bool), np.zeros(len(rows)), NO_RODS)
    faces = faces.reshape(-1, 3)
    return Garment(worn, faces, np.stack([0 * level, level - ankle], 1)[faces], _plain(rng))


ACCESSORIES: dict[str, Callable[[DressedBody, np.random.Generator], Garment]] = {
    "hat": _hat, "hair": _hair, "hood": _hood, "scarf": _scarf,
    "sleeves": _sleeves, "rucksack": _rucksack, "boots": _boots,
}  # fmt: skip

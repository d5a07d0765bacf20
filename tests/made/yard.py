"""A yard in the sun for path-traced clips, by chance: paving, brick walls, boxes and bushes, as Mitsuba's dictionaries.

Importing this module needs `pip install mitsuba`. Metres, y up, the floor at y = 0.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

BUSHES = (-3.0, -2.6), (3.2, -2.4), (-1.2, -3.1), (1.9, -3.0)


def yard(rng: np.random.Generator) -> dict[str, Any]:
    """The scene without anybody, for `mi.load_dict`; a variant of Mitsuba must be set."""
    around, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.0)
    sun = [np.cos(rise) * np.cos(around), np.sin(rise), np.cos(rise) * np.sin(around)]
    upright = _turn([1, 0, 0], -90)
    parts: dict[str, Any] = {"type": "scene"}
    hazy = float(rng.uniform(3, 6))
    parts["sky"] = {"type": "sunsky", "sun_direction": sun, "turbidity": hazy, "sun_scale": 0.5, "to_world": upright}
    stones = {"type": "twosided", "bsdf": _painted(_paving(rng), 4, 4)}
    parts["floor"] = {"type": "rectangle", "to_world": upright @ _scale([12, 12, 1]), "bsdf": stones}
    parts["back"] = _wall([0, 1.6, -3.6], 6, 9, 3.2, _painted(_bricks(rng, (0.55, 0.27, 0.2)), 3, 1))
    parts["left"] = _wall([-4.4, 1.3, -0.5], 80, 7, 2.6, _painted(_bricks(rng, (0.62, 0.57, 0.45)), 2.4, 0.9))
    parts["right"] = _wall([4.6, 1.9, -1.2], -75, 7, 3.8, _painted(_bricks(rng, (0.4, 0.42, 0.47), 20, 8), 2, 1))
    for k in range(9):
        x, z, size = rng.uniform(-3.6, 3.6), rng.uniform(-3.1, -1.6), rng.uniform(0.18, 0.42, 3)
        place = _move([x, size[1], z]) @ _turn([0, 1, 0], rng.uniform(0, 90)) @ _scale(size.tolist())
        spots = rng.uniform(0.15, 0.9, 3) * (1 + 0.35 * _noise(rng, 256, 5)[..., None])
        parts[f"box{k}"] = {"type": "cube", "to_world": place, "bsdf": _painted(spots)}
    for k in range(40):
        x, z = BUSHES[rng.integers(len(BUSHES))]
        radius = float(rng.uniform(0.15, 0.38))
        center = [x + rng.normal(0, 0.3), 0.5 + rng.uniform(0, 1.1), z + rng.normal(0, 0.15)]
        green = _painted(_leaves(rng), 3, 3)
        parts[f"bush{k}"] = {"type": "sphere", "center": center, "radius": radius, "bsdf": green}
    return parts


def _wall(at: list[float], turned: float, wide: float, tall: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    place = _move(at) @ _turn([0, 1, 0], turned) @ _scale([wide / 2, tall / 2, 0.15])
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def _painted(colors: np.ndarray, across: float = 1, down: float = 1) -> dict[str, Any]:
    """A matt surface of linear colors [S,S,3], repeated."""
    picture = mi.Bitmap(colors.clip(0.01, 0.95).astype(np.float32))
    repeated = {"to_uv": _scale([across, down, 1])} if (across, down) != (1, 1) else {}
    texture = {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "repeat"} | repeated
    return {"type": "diffuse", "reflectance": texture}


def _move(by: list[float]) -> Any:
    return mi.ScalarTransform4f().translate(by)


def _turn(axis: list[float], degrees: float) -> Any:
    return mi.ScalarTransform4f().rotate(axis, degrees)


def _scale(by: list[float]) -> Any:
    return mi.ScalarTransform4f().scale(by)


def _noise(rng: np.random.Generator, size: int, sigma: float) -> np.ndarray:
    """Periodic noise [size,size] of unit variance."""
    found = gaussian_filter(rng.standard_normal((size, size)), sigma, mode="wrap")
    return (found - found.mean()) / found.std()


def _bricks(
    rng: np.random.Generator, tone: tuple[float, float, float], rows: int = 32, columns: int = 12, size: int = 1024
) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    row = y * rows // size
    along, up = x * columns / size + 0.5 * (row % 2), y * rows / size
    brick = row, along.astype(int) % columns
    shade = rng.uniform(0.6, 1.25, (rows, columns))[brick][..., None] * (1 + 0.15 * _noise(rng, size, 2)[..., None])
    colors = np.array(tone) * shade * (1 + 0.2 * rng.uniform(-1, 1, (rows, columns, 3))[brick])
    joint = (along % 1 < 0.04) | (up % 1 < 0.1)
    colors[joint] = np.array([0.6, 0.58, 0.54]) * (1 + 0.05 * _noise(rng, size, 1)[joint][:, None])
    return colors


def _paving(rng: np.random.Generator, size: int = 2048, stones: int = 900) -> np.ndarray:
    """Flat stones of any shape, with joints between them."""
    y, x = np.mgrid[:size, :size]
    centers = cKDTree(rng.uniform(0, size, (stones, 2)), boxsize=size)
    far, which = centers.query(np.stack([x, y], -1).reshape(-1, 2), k=2)
    shade = rng.uniform(0.35, 0.7, (stones, 1)) * (1 + 0.12 * rng.uniform(-1, 1, (stones, 3)))
    grain = 1 + 0.12 * _noise(rng, size, 3)[..., None] + 0.08 * _noise(rng, size, 1)[..., None]
    colors = shade[which[:, 0]].reshape(size, size, 3) * grain
    colors[(far[:, 1] - far[:, 0]).reshape(size, size) < 5] = [0.22, 0.2, 0.17]
    return colors


def _leaves(rng: np.random.Generator, size: int = 512) -> np.ndarray:
    fine, coarse = _noise(rng, size, 2), _noise(rng, size, 7)
    lit = np.where((fine > 0.2)[..., None], [0.16, 0.32, 0.07], [0.05, 0.14, 0.04])
    return lit * (1 + 0.35 * coarse[..., None]).clip(0.3, 2)

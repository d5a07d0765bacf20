"""The room of the synthetic clip: walls, floor, furniture, and textures made from noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

TEXELS, PER_METRE = 768, 120.0
LEVELS = 5
PLANKS, CEILING, BACK, LEFT, RIGHT, WOOD, CLOTH, RUG = range(8)

# centre, half sizes (m), turn (rad), texture, tint; the floor is a little below 0, the rug's top is at 0
FURNITURE = (
    ((0.0, -0.004, 0.0), (1.15, 0.004, 0.9), 0.2, RUG, (1.0, 1.0, 1.0)),
    ((-2.2, 0.92, -1.75), (0.45, 0.93, 0.25), 0.0, WOOD, (0.95, 0.75, 0.55)),
    ((-2.2, 2.0, -1.78), (0.22, 0.15, 0.15), 0.4, CLOTH, (0.6, 0.9, 0.75)),
    ((1.75, 0.37, -1.5), (0.75, 0.38, 0.4), -0.15, CLOTH, (0.95, 0.55, 0.45)),
    ((1.8, 0.9, -1.85), (0.75, 0.16, 0.13), -0.15, CLOTH, (0.9, 0.5, 0.42)),
    ((-1.15, 0.22, -1.35), (0.24, 0.23, 0.24), 0.5, WOOD, (0.6, 0.75, 1.0)),
    ((-1.12, 0.58, -1.35), (0.13, 0.13, 0.13), 1.0, CLOTH, (1.0, 0.85, 0.4)),
    ((2.55, 0.55, 0.1), (0.25, 0.56, 0.55), 0.0, WOOD, (0.85, 0.85, 0.8)),
    ((2.5, 1.24, 0.0), (0.12, 0.13, 0.2), 0.6, CLOTH, (0.75, 0.6, 1.0)),
    ((-2.6, 0.3, 0.2), (0.3, 0.31, 0.5), 0.1, CLOTH, (0.55, 0.7, 0.9)),
    ((0.55, 1.75, -2.0), (0.4, 0.02, 0.12), 0.0, WOOD, (0.8, 0.6, 0.4)),
    ((0.4, 1.87, -2.0), (0.09, 0.1, 0.08), 0.3, CLOTH, (0.5, 0.8, 0.6)),
    ((0.7, 1.9, -2.0), (0.05, 0.13, 0.06), 0.0, WOOD, (1.0, 0.5, 0.4)),
)
ROOM = ((0.0, 1.292, 0.75), (3.0, 1.3, 2.85), (LEFT, RIGHT, PLANKS, CEILING, BACK, BACK))


@dataclass(frozen=True)
class Room:
    """Boxes and textures as `avatar.kernels.mesh.cast` takes them."""

    boxes: np.ndarray
    paint: np.ndarray
    tints: np.ndarray
    mips: tuple[np.ndarray, ...]
    per_metre: float = PER_METRE


def make_room(rng: np.random.Generator) -> Room:
    """A room 6 m by 5.7 m with furniture, y up, a person's place at the origin; colours 0..1."""
    boxes = [[*ROOM[0], *ROOM[1], 1.0, 0.0]]
    boxes += [[*center, *half, np.cos(turn), np.sin(turn)] for center, half, turn, _, _ in FURNITURE]
    paint = [ROOM[2]] + [(texture,) * 6 for _, _, _, texture, _ in FURNITURE]
    tints = [(1.0, 1.0, 1.0)] + [tint for *_, tint in FURNITURE]
    walls = [_wall(rng, color) for color in ((0.78, 0.74, 0.66), (0.62, 0.72, 0.74), (0.74, 0.66, 0.62))]
    stack = np.stack([_planks(rng), _plain(rng, (0.9, 0.9, 0.88), 0.05), *walls, _wood(rng), _cloth(rng), _rug(rng)])
    mips = [stack.clip(0, 1).astype(np.float32)]
    for _ in range(LEVELS - 1):
        upper, lower = mips[-1][:, ::2], mips[-1][:, 1::2]
        mips.append((upper[:, :, ::2] + upper[:, :, 1::2] + lower[:, :, ::2] + lower[:, :, 1::2]) / np.float32(4))
    return Room(np.array(boxes), np.array(paint), np.array(tints), tuple(mips))


def _noise(
    rng: np.random.Generator, slope: float = 1.0, finest: float = 0.04, coarsest: float = 1.5, stretch: float = 1
) -> np.ndarray:
    """Periodic noise [S,S] of unit variance: amplitude falls with frequency^slope between two wavelengths in metres.

    `stretch` > 1 makes it longer along x by that factor.
    """
    down, right = np.fft.fftfreq(TEXELS, 1 / PER_METRE), np.fft.rfftfreq(TEXELS, 1 / PER_METRE)
    f = np.hypot(down[:, None], right[None] * stretch)
    gain = np.where((f > 1 / coarsest) & (f < 1 / finest), np.maximum(f, 1e-9) ** -slope, 0)
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TEXELS, TEXELS))) * gain)
    return noise / noise.std()


def _plain(rng: np.random.Generator, color: tuple[float, float, float], contrast: float) -> np.ndarray:
    return np.array(color) * (1 + contrast * _noise(rng)[..., None])


def _wall(rng: np.random.Generator, color: tuple[float, float, float]) -> np.ndarray:
    """Painted plaster with pictures on it, each of its own noise in two colours."""
    wall = _plain(rng, color, 0.07) + 0.025 * _noise(rng, 0.5, 0.03, 0.2)[..., None]
    pattern = _noise(rng, 1.3, 0.035, 0.5)
    cell = TEXELS // 8
    for x, y in np.ndindex(8, 8):
        half = rng.uniform(0.13, 0.3, 2) * PER_METRE
        center = rng.uniform(0.35, 0.65, 2) * cell
        inks = rng.uniform(0.12, 0.95, (3, 3))
        if rng.random() < 0.35:
            continue
        spot = np.s_[y * cell : (y + 1) * cell, x * cell : (x + 1) * cell]
        rows, columns = np.mgrid[:cell, :cell]
        inside = np.minimum(half[0] - abs(columns - center[0]), half[1] - abs(rows - center[1]))
        mix = step(pattern[spot], 0.25)[..., None]
        picture = np.where((inside < 0.04 * PER_METRE)[..., None], inks[2] * 0.6, inks[0] * mix + inks[1] * (1 - mix))
        cover = step(inside, 1.0)[..., None]
        wall[spot] = wall[spot] * (1 - cover) + picture * cover
    return wall


def _planks(rng: np.random.Generator) -> np.ndarray:
    """Boards along x, each of its own tone, with grain and dark joints."""
    width = TEXELS // 40
    board = np.arange(TEXELS) // width % 40
    tone = rng.uniform(0.75, 1.1, 41)[board][:, None]
    joint = 1 - 0.35 * (np.arange(TEXELS) % width < 1.5)[:, None]
    grain = 1 + 0.07 * _noise(rng, 0.8, 0.03, 0.8, stretch=6) + 0.09 * _noise(rng, 1.0, 0.05, 0.6)
    return np.array([0.66, 0.5, 0.36]) * (tone * joint * grain)[..., None]


def _wood(rng: np.random.Generator) -> np.ndarray:
    grain = 0.12 * _noise(rng, 0.8, 0.03, 0.8, stretch=5) + 0.12 * _noise(rng, 1.0, 0.04, 0.5)
    knots = 1 - 0.5 * step(_noise(rng, 1.0, 0.08, 0.3) - 2.0, 0.2)
    return np.array([0.8, 0.75, 0.7]) * ((0.85 + grain) * knots)[..., None]


def _cloth(rng: np.random.Generator) -> np.ndarray:
    dots = step(_noise(rng, 1.0, 0.05, 0.3) - 0.6, 0.3)[..., None]
    return np.array([0.85, 0.85, 0.85]) * (1 + 0.08 * _noise(rng)[..., None]) * (1 - 0.45 * dots)


def _rug(rng: np.random.Generator) -> np.ndarray:
    """Three colours in blots over a wide weave."""
    first = step(_noise(rng, 1.6, 0.07, 0.7), 0.4)[..., None]
    second = step(_noise(rng, 1.5, 0.06, 0.5) - 0.5, 0.4)[..., None]
    ground = np.array([0.36, 0.47, 0.46]) * first + np.array([0.56, 0.55, 0.5]) * (1 - first)
    return (ground * (1 - second) + np.array([0.76, 0.72, 0.62]) * second) * (1 + 0.06 * _noise(rng)[..., None])


def step(x: np.ndarray, width: float) -> np.ndarray:
    """0 below, 1 above zero, with a smooth edge."""
    t = (x / width + 0.5).clip(0, 1)
    return t * t * (3 - 2 * t)

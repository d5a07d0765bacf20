"""Strangers who walk through the room of the synthetic clip behind the person."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RINGS, SLICES = 24, 20
FAR = 3.6  # m to the side where a walk begins and ends, behind the walls
WALK = 0.7  # of the clip that a walk takes


@dataclass(frozen=True)
class Passer:
    """An upright ellipsoid in stripes that crosses the room: `vertices` [V,3] m around its middle, `colors` [V,3]."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    depth: float
    direction: float
    middle: float
    """The frame at which they are before the middle of the room."""
    frames: int

    def inside(self, t: float) -> bool:
        """Whether they are between the walls, or in them, at moment `t`."""
        return abs(t - self.middle) < WALK * self.frames / 2

    def at(self, t: float) -> np.ndarray:
        """Vertices [V,3] m at moment `t`, in frames."""
        gone = (t - self.middle) / (WALK * self.frames)
        bob = 0.02 * np.sin(12 * np.pi * gone)
        return self.vertices + [self.direction * 2 * FAR * gone, self.vertices[:, 1].max() + bob, self.depth]


def make_passers(count: int, frames: int, rng: np.random.Generator) -> list[Passer]:
    """`count` strangers of different sizes, stripes, depths and times."""
    return [_passer((i + 0.5 + rng.uniform(-0.2, 0.2)) / count * frames, frames, rng) for i in range(count)]


def _passer(middle: float, frames: int, rng: np.random.Generator) -> Passer:
    polar, turn = np.meshgrid(np.linspace(0, np.pi, RINGS), np.linspace(0, 2 * np.pi, SLICES), indexing="ij")
    ball = np.stack([np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], -1).reshape(-1, 3)
    corner = (np.arange(RINGS - 1)[:, None] * SLICES + np.arange(SLICES - 1)).ravel()
    faces = np.concatenate([
        np.stack([corner, corner + 1, corner + SLICES], 1),
        np.stack([corner + 1, corner + SLICES + 1, corner + SLICES], 1),
    ])  # fmt: skip
    inks = rng.uniform(0.1, 0.9, (3, 3))
    stripe = (np.arange(RINGS) // rng.integers(2, 5) % 2)[:, None] + (np.arange(SLICES) // 5 % 2)[None]
    size = np.array([0.25, rng.uniform(0.75, 0.88), 0.2])
    return Passer(
        ball * size, faces, inks[stripe.ravel()], rng.uniform(-1.0, -0.75), rng.choice([-1.0, 1.0]), middle, frames
    )

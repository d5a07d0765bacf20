"""What the camera solvers get, and what they give."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import Job
from stages.estimators.cameras.intrinsics import Prior, usual
from stages.estimators.cameras.parts import Parts

GIVEN_SPREAD = 0.001  # of a focal length that the user gives
GUESSED_FOCAL = 1.2  # of the longer side: COLMAP's guess, between a phone's wide lens (0.75) and twice its zoom


@dataclass(frozen=True)
class Task:
    """Frames `names` of `size` (width, height) px in `images`, their person in `masks`; settings as in stages/sfm.py.

    `told` is what the file says of its focal length; `moves`: the user says that the camera does.
    """

    job: Job
    names: list[str]
    size: tuple[int, int]
    images: Path
    masks: Path
    scratch: Path
    parts: Parts
    features: int
    overlap: int
    min_share: float
    focal: float | None = None
    told: Prior | None = None
    moves: bool = False

    @property
    def files(self) -> list[str]:
        """The frames' file names."""
        return [f"{name}.png" for name in self.names]

    @property
    def side(self) -> int:
        """The frames' longer side in px."""
        return max(self.size)

    @property
    def center(self) -> tuple[float, float]:
        """The frames' middle in px."""
        return self.size[0] / 2, self.size[1] / 2

    @property
    def known_focal(self) -> float | None:
        """Focal length in px that the user or the file gives."""
        return self.focal or (self.told.focal if self.told else None)

    @property
    def prior(self) -> Prior:
        """What is known of the focal length before the frames are seen."""
        return Prior(self.focal, GIVEN_SPREAD, "given") if self.focal else self.told or usual(self.side)


@dataclass
class Solution:
    """Solved cameras: poses and focal lengths [C] px of `names`, the lens, the COLMAP model, and facts for sfm.json."""

    verdict: str
    names: list[str]
    viewmats: np.ndarray
    focals: np.ndarray
    center: tuple[float, float]
    k: float
    model: Any = None
    facts: dict[str, Any] = field(default_factory=dict)


def fixed_views(count: int) -> np.ndarray:
    """`count` cameras at the origin that look along z [count,4,4]."""
    return np.tile(np.eye(4), (count, 1, 1))

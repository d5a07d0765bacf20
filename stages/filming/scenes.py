"""Scenes from files of other programs: which way up they stand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.avatar.splats.turn import OVER, turned
from stages.filming.spec import Axes
from stages.records import Ground, Scene

AROUND, FLAT = 4.0, 0.1  # m from the floor's point, and above or below the floor, in which its Gaussians lie
SOLID = 0.3  # opacity from which a Gaussian may be floor
FLOOR, FAINT = 0.02, 0.25
"""The share of a scene's solid Gaussians that a floor has at least (0.18 to 0.35 in three clips), and of that share what a scene
that lies on its head has where the floor should be (none there)."""


def stood(scene: Scene, axes: Axes, ground: Ground | None) -> Scene:
    """The scene of a file with y down: turned where its `axes` are y_up. It says so where it lies on its head over its `ground`."""
    scene = scene if axes == "y_down" else turned(scene, OVER)
    if ground is None or not on_its_head(scene, ground):
        return scene
    other = "y_up" if axes == "y_down" else "y_down"
    fact = (
        "the scene is upside down: after half a turn its floor is where it should be; "
        f"--scene-axes {other} (in a film `scene_axes: {other}`) turns it"
    )
    return replace(scene, said=(*scene.said, fact))


def on_its_head(scene: Scene, ground: Ground) -> bool:
    """Whether the floor of `ground` is in the scene only after half a turn about x."""
    here, there = (_floor_share(means, scene.opacities, ground) for means in (scene.means, scene.means @ OVER.T))
    return there > FLOOR and here < FAINT * there


def _floor_share(means: np.ndarray, opacities: np.ndarray, ground: Ground) -> float:
    """The share of solid Gaussians that lie in the floor, near its point."""
    away = means - ground.point
    height = away @ ground.up
    near = np.linalg.norm(away - height[:, None] * ground.up, axis=1) < AROUND
    solid = opacities > SOLID
    return float((near & (np.abs(height) < FLAT) & solid).sum() / max(solid.sum(), 1))

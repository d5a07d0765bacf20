"""The stage of a page: what of a scene it shows beside the clip's own view, and the background that people stand off from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stages.formats.images import evenly
from stages.records import SH_C0, Cameras, Rig, Scene

REACH = 1.5  # standard deviations: a Gaussian is its middle and both ends of its longest axis
SAMPLED, ENOUGH = 24, 0.1  # cameras looked through, and the share of them that must have a Gaussian in their pictures
EDGE = 0.08  # of a picture's shorter side, over which what nears its edge fades
THIN, NEAR, FAR = 0.1, 1.0, 3.0  # m: half the floor's thickness; where it begins to end, and where it has ended
STAGES = (0x141517, 0x6B6D73)  # 0xrrggbb, dark and lighter
LUMA = np.array([0.2126, 0.7152, 0.0722])


def seen(scene: Scene, cameras: Cameras) -> np.ndarray:
    """How far each Gaussian [N] of `scene` lies within pictures of the cameras, 0 to 1; both in one world."""
    chosen = evenly(len(cameras), SAMPLED)
    projections = (cameras.Ks[chosen] @ cameras.viewmats[chosen, :3]).astype(np.float32)
    corner, enough = np.array([[cameras.width], [cameras.height]], np.float32), math.ceil(ENOUGH * len(chosen))
    least = np.ones(len(scene), np.float32)
    for points in _points(scene):
        inside = np.zeros((len(chosen), len(scene)), np.float32)
        for row, projection in zip(inside, projections, strict=True):
            x, y, z = projection[:, :3] @ points.T + projection[:, 3:]
            at = np.stack([x, y]) / np.maximum(z, 1e-6)
            row[:] = np.where(z > 0, np.minimum(at, corner - at).min(0) / (EDGE * corner.min()), 0)
        least = np.minimum(least, np.partition(inside, -enough, axis=0)[-enough])
    return least.clip(0, 1)


def underfoot(scene: Scene, turn: np.ndarray, spot: np.ndarray) -> np.ndarray:
    """How much of each Gaussian [N] of `scene` is floor around people, 0 to 1; `turn` [3,3] and `spot` [3] m as in `Exhibit`."""
    points = (_points(scene) - spot) @ turn
    flat = (np.abs(points[..., 1]) < THIN).all(0)
    return flat * ((FAR - np.hypot(points[0, :, 0], points[0, :, 2])) / (FAR - NEAR)).clip(0, 1)


def background(people: Sequence[Rig]) -> int:
    """The colour 0xrrggbb of `STAGES` whose luminance is farther from the people's mean, by what each Gaussian covers."""
    lumas = np.concatenate([(0.5 + SH_C0 * rig.sh0.reshape(-1, 3)) @ LUMA for rig in people])
    mean = np.average(lumas, weights=np.concatenate([covered(rig) for rig in people]))
    return max(STAGES, key=lambda stage: abs(np.array(list(stage.to_bytes(3, "big"))) @ LUMA / 255 - mean))


def covered(scene: Scene) -> np.ndarray:
    """What each Gaussian [N] covers: opacity times the product of its two longer axes, m^2."""
    return scene.opacities * np.sort(scene.scales, axis=1)[:, 1:].prod(1)


def _points(scene: Scene) -> np.ndarray:
    """Of each Gaussian its middle and the ends of its longest axis [3,N,3], float32."""
    longest = np.eye(3)[scene.scales.argmax(1)] * scene.scales.max(1, keepdims=True)
    axes = Rotation.from_quat(scene.quats, scalar_first=True).apply(longest)
    return np.stack([scene.means + far * axes for far in (0, -REACH, REACH)]).astype(np.float32)

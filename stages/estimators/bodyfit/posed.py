"""Posed bodies: their vertices, and which of them the body itself hides from a camera."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import onto
from stages.avatar.kernels.mesh import NEAR, fill
from stages.records import BodyModel, BodyPoses

VISIBLE_SIDE, HIDDEN = 160, 0.02  # px; m
TOGETHER = 8  # frames that are posed at once


def posed_vertices(model: BodyModel, poses: BodyPoses) -> Iterator[np.ndarray]:
    """Vertices [V,3] float64 m in the world of each frame in turn; placed in float64, however far the world's origin is."""
    body = Body(model)
    betas = _tensor(poses.betas)
    for first in range(0, len(poses), TOGETHER):
        rows = slice(first, first + TOGETHER)
        parts = (poses.global_orient[rows], poses.body_pose[rows], 0 * poses.transl[rows])
        yield from body(betas, *map(_tensor, parts))[0].double().numpy() + poses.transl[rows, None]


def posed_bodies(model: BodyModel, poses: BodyPoses, rows: Sequence[int]) -> np.ndarray:
    """Vertices [N,V,3] float64 m in the world of the bodies in `rows`; placed in float32, as training does."""
    chosen = list(rows)
    parts = (poses.global_orient[chosen], poses.body_pose[chosen], poses.transl[chosen])
    with torch.no_grad():
        return Body(model)(_tensor(poses.betas), *map(_tensor, parts))[0].double().numpy()


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32)


def seen_vertices(points: np.ndarray, faces: np.ndarray, Ks: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """bool [F,M]: the vertices `chosen` [M] that no other part of the body hides; `points` [F,V,3] m in camera axes.

    `faces` [T,3], `Ks` [F,3,3] px. The bodies are drawn VISIBLE_SIDE px large; what is HIDDEN behind the drawn surface is hidden.
    """
    seen = np.zeros((len(points), len(chosen)), bool)
    for i, (body, K) in enumerate(zip(points, Ks, strict=True)):
        body = body * [1, 1, 0] + [0, 0, 1] * body[:, 2:].clip(NEAR)
        pixels = onto(body, K)
        low, side = pixels.min(0), max(np.ptp(pixels, axis=0).max(), 1e-6)
        zoom = VISIBLE_SIDE / side
        into = np.array(
            [[zoom * K[0, 0], 0, zoom * (K[0, 2] - low[0])], [0, zoom * K[1, 1], zoom * (K[1, 2] - low[1])], [0, 0, 1]]
        )
        depth = fill(body, faces, into, VISIBLE_SIDE, VISIBLE_SIDE)[0]
        column, row = ((pixels[chosen] - low) * zoom).astype(int).clip(0, VISIBLE_SIDE - 1).T
        seen[i] = body[chosen, 2] < depth[row, column] + HIDDEN
    return seen

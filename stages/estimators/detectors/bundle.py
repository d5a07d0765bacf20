"""Residuals of the tracks against the cameras: errors of camera poses, a rolling shutter, a lens.

One linearised bundle adjustment (Triggs et al. 2000). Each camera may move a little, each point freely; one number for the
clip says how long a frame takes to be read, another how the lens bends. All are solved at once, so none passes for another.

`cameras/adjustment.py` is no substitute: it moves cameras freely until nothing is left over. Here they are known to be off by
little (TURN, MOVE), and how much of the error goes when they move is what is measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.estimators.detectors.tracks import Tracks, project_with_slopes

FEWEST, MOST = 40, 1500  # points that must be placed; that are used, those seen longest
NOISE_PX = 0.3  # of a followed corner; only weighs the two lines below
TURN, MOVE = 0.01, 0.01  # how far a camera may be off: rad, and share of the median depth
ROUNDS = 4  # of weights that fade with the error
OUTLIER = 4.0  # times the median error


@dataclass(frozen=True)
class BundleResiduals:
    """`readout` and its standard deviation in frame intervals, `k` and its own (as in SIMPLE_RADIAL).

    `speed_px` [F] is the median motion of the background a frame; `mended_px` [F] how much of each frame's errors goes
    when all cameras are mended.
    """

    readout: float
    readout_std: float
    k: float
    k_std: float
    speed_px: np.ndarray
    mended_px: np.ndarray


def adjust_bundle(tracks: Tracks, viewmats: np.ndarray, Ks: np.ndarray, height: int) -> BundleResiduals | None:
    """Adjust the bundle; None if too few points are placed."""
    placed = np.isfinite(tracks.points).all(1)
    if placed.sum() < FEWEST:
        return None
    size = np.sqrt(np.nansum(tracks.errors**2, (0, 2)) / np.maximum(tracks.lengths, 1))
    good = np.flatnonzero(placed & (size < OUTLIER * np.median(size[placed])))
    good = good[np.argsort(-tracks.lengths[good], kind="stable")[:MOST]]
    errors, pixels, points = tracks.errors[:, good], tracks.pixels[:, good], tracks.points[good]
    seen = np.isfinite(errors[..., 0])
    there, z, by_point = project_with_slopes(points, viewmats, Ks)
    speed = np.nan_to_num(np.gradient(there, axis=0))  # a point may be behind the next camera
    u = (pixels - Ks[:, None, :2, 2]) / Ks[:, None, [0, 1], [0, 1]]
    columns = [
        speed * (pixels[..., 1:] / height - 0.5),
        u * (u**2).sum(-1, keepdims=True) * Ks[:, None, [0, 1], [0, 1]],
    ]
    shared = np.where(seen[..., None, None], np.stack(columns, -1), 0)
    by_point, by_camera = (
        np.where(seen[..., None, None], s, 0) for s in (by_point, _by_camera(points, viewmats, by_point))
    )
    errors = np.where(seen[..., None], errors, 0)
    weights, prior = seen.astype(float), np.repeat([TURN, MOVE * np.median(z[seen])], 3)
    for _ in range(ROUNDS):
        found, covariance, rest = _solve(errors, weights, by_point, by_camera, shared, prior)
        off = np.linalg.norm(rest, axis=-1)
        scale = 1.5 * np.median(off[seen]) + 1e-3
        weights = seen / (1 + (off / scale) ** 2)
    readout, k = found[-2:]
    before = _medians(np.linalg.norm(errors - shared @ found[-2:], axis=-1), seen)
    mended = np.sqrt(np.maximum(before**2 - _medians(off, seen) ** 2, 0))
    stds = np.sqrt(np.diag(covariance)[-2:])
    return BundleResiduals(readout, stds[0], k, stds[1], _medians(np.linalg.norm(speed, axis=-1), seen), mended)


def _medians(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The median [F] of each row of `values` [F,T] where `seen`, 0 in a row without any."""
    return np.array([np.median(row[there]) if there.any() else 0.0 for row, there in zip(values, seen)])


def _by_camera(points: np.ndarray, viewmats: np.ndarray, by_point: np.ndarray) -> np.ndarray:
    """Slopes [F,T,2,6] of pixels by a turn (rad) and a move of each camera, both in its own axes."""
    local = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    by_local = by_point @ viewmats[:, None, :3, :3].mT
    turned = np.cross(local[..., None, :], np.eye(3))  # d(w x p) / dw
    return np.concatenate([by_local @ turned, by_local], -1)


def _solve(
    errors: np.ndarray,
    weights: np.ndarray,
    by_point: np.ndarray,
    by_camera: np.ndarray,
    shared: np.ndarray,
    prior: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares with the points eliminated (Schur complement): parameters, their covariance, errors left [F,T,2]."""
    frames, count = weights.shape
    poses, both = 6 * frames, 6 * frames + shared.shape[-1]
    V = np.einsum("ft,ftki,ftkj->tij", weights, by_point, by_point)
    V += np.trace(V, axis1=1, axis2=2)[:, None, None] * 1e-9 * np.eye(3)
    W = np.zeros((both, count, 3))
    W[:poses] = np.einsum("ft,ftki,ftkj->fitj", weights, by_camera, by_point).reshape(poses, count, 3)
    W[poses:] = np.einsum("ft,ftki,ftkj->itj", weights, shared, by_point)
    N, g = np.zeros((both, both)), np.zeros(both)
    blocks = np.einsum("ft,ftki,ftkj->fij", weights, by_camera, by_camera)
    for f, block in enumerate(blocks):
        N[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] = block
    N[:poses, poses:] = np.einsum("ft,ftki,ftkj->fij", weights, by_camera, shared).reshape(poses, -1)
    N[poses:, :poses] = N[:poses, poses:].T
    N[poses:, poses:] = np.einsum("ft,ftki,ftkj->ij", weights, shared, shared)
    g[:poses] = np.einsum("ft,ftki,ftk->fi", weights, by_camera, errors).ravel()
    g[poses:] = np.einsum("ft,ftki,ftk->i", weights, shared, errors)
    b = np.einsum("ft,ftki,ftk->ti", weights, by_point, errors)
    inverse = np.linalg.inv(V)
    N -= np.einsum("atj,tjk->atk", W, inverse).reshape(both, -1) @ W.reshape(both, -1).T
    g -= np.einsum("atj,tj->a", W, (inverse @ b[..., None])[..., 0])
    N[np.arange(poses), np.arange(poses)] += np.tile((NOISE_PX / prior) ** 2, frames)
    covariance = np.linalg.inv(N)
    found = covariance @ g
    moved = (inverse @ (b - np.einsum("atj,a->tj", W, found))[..., None])[..., 0]
    rest = errors - np.einsum("ftki,ti->ftk", by_point, moved) - shared @ found[poses:]
    rest = rest - np.einsum("ftki,fi->ftk", by_camera, found[:poses].reshape(frames, 6))
    spread = (weights[..., None] * rest**2).sum() / max(2 * (weights > 0).sum() - both - 3 * count, 1)
    return found, covariance * spread, rest

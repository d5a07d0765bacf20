"""Tells from feature matches alone whether the camera moves, only turns, or stands still, before any mapping.

Mapping cannot tell: of a pure rotation it makes a complete model with an invented baseline and a small reprojection
error (COLMAP: colmap/colmap#1411, #2858).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from stages.avatar.cameras import lens

SAMPLES = 100  # matches a pair that the rotation fit looks at; evenly strided, so it needs no random numbers
MIN_MATCHES = 30  # fewer verified matches say too little about a pair
MAX_PAIRS = 80  # the farthest pairs only: there translation shows best
STATIC_PX = 0.0015  # of the longer side: 1.4 px at 960; compression noise is 0.3 px, the slowest hand 5 px
ROTATION_PX = 0.0015  # of the longer side: what a pure rotation may leave unexplained (0.2-0.5 px is usual)
MIN_FOCAL, MAX_FOCAL = 0.4, 3.0  # of the longer side: 100 to 19 degrees; zooms reach 85 mm, 2.4 of it
STRAIGHT = 1.0  # share of what is left over that a k of 1 must win: lenses win 30 % and more, little depth 1 to 4 %
ROTATION_SHARE = 0.03  # and of the displacement: a hand that moves leaves 0.1 and more
NEARLY = 3  # times that: the limit for a rotation that stands in where mapping fails


@dataclass(frozen=True)
class Pair:
    """Verified matches between frames `first` < `second` (positions in the clip): pixels `a`, `b` [N,2]."""

    first: int
    second: int
    a: np.ndarray
    b: np.ndarray


@dataclass(frozen=True)
class CameraMotion:
    """The camera's motion by the matches: verdict "moving", "rotation only" or "static camera", and the numbers behind it.

    `nearly_turns`: a rotation leaves less than ROTATION_PX or NEARLY times its limit; it may stand in where mapping fails.
    """

    verdict: str
    displacement_px: float
    rotation_residual_px: float | None = None
    rotation_limit_px: float | None = None
    focal_px: float | None = None
    k: float | None = None
    nearly_turns: bool = False


def judge_motion(pairs: list[Pair], width: int, height: int, known: float | None = None) -> CameraMotion:
    """Name the camera's motion from `pairs` at growing gaps in time; `known` is the focal length in px, if it is.

    Static: at every gap the median match moves less than STATIC_PX of the longer side. Rotation only: one focal
    length, one lens and one rotation a pair explain the farthest pairs to ROTATION_PX and ROTATION_SHARE.
    """
    side = max(width, height)
    moved = np.array([np.median(np.linalg.norm(pair.a - pair.b, axis=1)) for pair in pairs])
    gaps = np.array([pair.second - pair.first for pair in pairs])
    by_gap = [np.median(moved[gaps == gap]) for gap in np.unique(gaps)]
    if max(by_gap) < STATIC_PX * side:
        return CameraMotion("static camera", float(max(by_gap)))
    order = np.argsort(-moved, kind="stable")
    far = [i for i in order if len(pairs[i].a) >= MIN_MATCHES][:MAX_PAIRS]
    if not far:
        return CameraMotion("moving", float(max(by_gap)))
    focal, k, residuals = fit_rotation_camera([pairs[i] for i in far], width, height, known)
    residual, displacement = np.fmin([np.median(residuals), np.median(moved[far])], np.hypot(width, height)).tolist()
    limit = min(ROTATION_PX * side, ROTATION_SHARE * displacement)
    # A flat wall seen by a sliding camera looks like a turn with ever longer focal length: one at the limit is not believed.
    believable = known is not None or focal < 0.95 * MAX_FOCAL * side
    verdict = "rotation only" if believable and residual < limit else "moving"
    inside = known is not None or focal > 1.05 * MIN_FOCAL * side
    nearly = believable and inside and residual < max(NEARLY * limit, ROTATION_PX * side)
    return CameraMotion(verdict, displacement, residual, limit, focal, k, nearly)


def fit_rotation_camera(
    pairs: list[Pair], width: int, height: int, focal: float | None = None
) -> tuple[float, float, np.ndarray]:
    """The focal length (px) and radial k with which pure rotations explain `pairs` best, a straight lens before a bent one.

    Also returns what they leave of each pair: the median distance in px of a turned match from its partner [P].
    """
    a, b = (np.stack([_sample(getattr(pair, side)) for pair in pairs]) for side in ("a", "b"))
    center, side = np.array([width / 2, height / 2]), max(width, height)

    farthest = (np.abs(np.concatenate([a, b]) - center).max((0, 1)) ** 2).sum()

    def leftover(f: float, k: float) -> np.ndarray:
        if k * farthest / f**2 < -0.12:  # near the radius where the lens folds over
            return np.full(len(pairs), float(side))
        rays_a, rays_b = (rays_of((points - center) / f, k) for points in (a, b))
        turned = rays_a @ rotations_between(rays_a, rays_b, 2 / f).mT
        return np.median(np.linalg.norm(turned - rays_b, axis=-1), axis=1) * f

    def cost(log_focal: float, k: float) -> float:
        return float(leftover(np.exp(log_focal) * side, k).mean()) * (1 + STRAIGHT * abs(k))

    log_limits = (np.log(focal / side),) * 2 if focal else (np.log(MIN_FOCAL), np.log(MAX_FOCAL))
    tries = []
    for k in np.linspace(-0.15, 0.15, 7):
        slices = np.linspace(*log_limits, 1 if focal else 9)
        tries += [(cost(log_focal, k), log_focal, k) for log_focal in slices]
    _, log_focal, k = min(tries)
    step = np.array([[0, 0], [0.1, 0], [0, 0.03]]) * [not focal, 1]
    best = minimize(
        lambda guess: cost(*guess),
        [log_focal, k],
        bounds=[log_limits, (-0.3, 0.3)],
        method="Nelder-Mead",
        options={"initial_simplex": [log_focal, k] + step, "xatol": 1e-4, "fatol": 1e-4, "maxfev": 150},
    ).x
    found = float(np.exp(best[0]) * side)
    return found, float(best[1]), leftover(found, best[1])


def rotations_between(a: np.ndarray, b: np.ndarray, noise: float) -> np.ndarray:
    """Rotations [P,3,3] that take unit rays `a` [P,N,3] to `b`, matches farther off than `noise` (rad) fading out.

    Source: Kabsch 1976 with Cauchy weights, three rounds.
    """
    weights = np.ones(a.shape[:-1])
    for _ in range(3):
        rotations = _nearest_rotations((b * weights[..., None]).mT @ a)
        weights = 1 / (1 + ((a @ rotations.mT - b) ** 2).sum(-1) / noise**2)
    return rotations


def camera_rotations(
    pairs: list[Pair], count: int, focal: float, k: float, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations camera_from_world [count,3,3] of a camera that only turns, and which frames they are known for [count].

    Chained along the strongest matches, then averaged over all pairs (Govindu 2004 in its chordal form); the first
    known frame is the identity. Frames that no pair joins to the others stay the identity and are marked unknown.
    """
    center = np.array([width / 2, height / 2])
    edges = []
    for pair in pairs:
        a, b = (rays_of((points - center) / focal, k)[None] for points in (pair.a, pair.b))
        edges.append((pair.first, pair.second, rotations_between(a, b, 2 / focal)[0], len(pair.a)))
    turns, known = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, dtype=bool)
    if edges:
        known[max(edges, key=lambda edge: edge[3])[0]] = True
    while frontier := [edge for edge in edges if known[edge[0]] != known[edge[1]]]:
        first, second, turn, _ = max(frontier, key=lambda edge: edge[3])
        if known[first]:
            turns[second] = turn @ turns[first]
        else:
            turns[first] = turn.T @ turns[second]
        known[[first, second]] = True
    edges = [edge for edge in edges if known[edge[0]]]
    for _ in range(30):
        total = np.where(known[:, None, None], 0.0, turns)
        for first, second, turn, weight in edges:
            total[second] += weight * turn @ turns[first]
            total[first] += weight * turn.T @ turns[second]
        turns = _nearest_rotations(total)
    start = turns[np.argmax(known)]
    return np.where(known[:, None, None], turns @ start.T, np.eye(3)), known


def _nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(matrices)
    U[..., 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return U @ Vt


def _sample(points: np.ndarray) -> np.ndarray:
    return points[np.linspace(0, len(points) - 1, SAMPLES).round().astype(int)]


def rays_of(points: np.ndarray, k: float) -> np.ndarray:
    """Unit rays [...,3] to `points` [...,2], in focal lengths from the middle of a picture with radial `k`."""
    ideal = lens.undistort(points, k)
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

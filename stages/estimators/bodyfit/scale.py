"""Metres per SfM unit: from the floor under the feet and from feet that stand still while the camera moves.

A person of known size gives every frame its depth in metres. With the camera's place C in SfM units and a point f of
the body in metres from the camera (world axes), the point stands at f + s C: everything below is linear in s.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.avatar.cameras.pinhole import camera_centers, project
from stages.estimators.ground import STEEPEST, Plane, best_plane

SOLE = 0.012  # m from a standing foot to the floor: between bare feet, 0, and shoes, 0.02
NEAR_FEET = 0.5  # body heights in the picture within which a point may belong to the floor
ENOUGH = 25  # points that make a floor
NEARBY = 8  # of the body's points, one in so many is looked around for a floor where there is none about the feet
LONG = 0.9  # of the length at which a body stands: lying, bent or crouching, its depth is less sure
GUESS = 0.1  # of the scale, where feet are never in the picture
LEAST_STANDING = 0.1  # of the frames
STILL_ERROR = 0.15  # of the scale by feet that stand still, from which on it says nothing
FIRM = 0.05  # and up to which it refuses a floor
APART = 0.3  # of the scale, by which frames on a floor, or a floor and firm feet, may differ
INLIER = 0.008  # distance from the plane over distance from the camera


@dataclass(frozen=True)
class TimedCameras:
    """Cameras of F frames: `viewmats` [F,4,4] and `centers` [F,3] in SfM units, `Ks` [F,3,3] px, `times` [F] s, `size` px."""

    viewmats: np.ndarray
    Ks: np.ndarray
    centers: np.ndarray
    times: np.ndarray
    size: tuple[int, int]

    def see(self, points: np.ndarray) -> np.ndarray:
        """Pixels [F,N,2] of points [F,N,3] m from each frame's camera, world axes; what is behind it is brought before it."""
        local = points @ self.viewmats[:, :3, :3].mT
        return (local / local[..., 2:].clip(0.05)) @ self.Ks[:, :2].mT

    def show(self, pixels: np.ndarray) -> np.ndarray:
        """bool [F]: frames whose picture holds their pixel of `pixels` [F,2]."""
        return np.all((pixels >= 0) & (pixels <= np.array(self.size)), axis=-1)


def find_scale(
    path: TimedCameras | None,
    points: np.ndarray | None,
    body: np.ndarray,
    soles: int,
    height: np.ndarray,
    ups: np.ndarray,
) -> tuple[dict[str, Any], Plane | None]:
    """Metres per SfM unit (`initial`), `how` it was found with numbers, and the floor if there is one.

    `path` None: one fixed camera. `body` [F,P,3] m: points on the skin from the camera, world axes, of which the first `soles`
    are under the left foot, then as many under the right; `height` [F] px of the person; `ups` [U,3]: likely up axes.
    """
    if path is None:
        return {"initial": 1.0, "how": "one fixed camera: the world is its frame, in metres"}, None
    found: dict[str, Any] = {}
    feet = body[:, : 2 * soles]
    still = still_scale(feet.reshape(len(body), 2, soles, 3).mean(2), path.centers, path.times)
    if still is not None:
        found |= {"from_still_feet": still[0], "still_feet_error": still[1]}
    pixels = path.see(body)
    floor = None
    if points is not None:
        for near in (pixels[:, : 2 * soles], pixels[:, 2 * soles :: NEARBY]):  # the feet may be out of the picture
            floor = floor or find_floor(points, path.viewmats, path.Ks, near, height, ups)
    if floor is not None:
        lowest = (body @ floor.normal).argmin(1)
        shown = path.show(pixels[np.arange(len(body)), lowest])
        length = lengths_across(body)
        long = length >= LONG * np.quantile(length, 0.9)
        for standing, guess in ((shown & long, 0.0), (shown, 0.0), (long, GUESS)):
            on_floor = floor_scale(floor, body[standing], path.centers[standing])
            if on_floor is None or standing.sum() < LEAST_STANDING * len(body):
                continue
            found |= {"floor_spread": on_floor[1] + guess, "floor_points": floor.members}
            if not is_stood_on(on_floor, still):
                found["floor_refused"] = on_floor[0]
                break
            guessed = "; no picture shows what touches it, legs are taken for straight" if guess else ""
            how = f"the body stands on the floor's SfM points{guessed}"
            return found | {"initial": on_floor[0], "how": how}, floor
    how = "standing feet do not slide while the camera moves"
    if still is None or still[1] >= STILL_ERROR:
        how = "not found: no floor and no standing foot"
    return found | {"initial": still[0] if still is not None else 1.0, "how": how}, None


def is_stood_on(on_floor: tuple[float, float], still: tuple[float, float] | None) -> bool:
    """Whether a floor can be what the person stands on, that gives the scale and its spread `on_floor`.

    Not if frames that should agree differ by more than APART, as of somebody in the air; nor if feet that stand `still`
    firmly contradict it: the plane is a table before the legs, or the person stands on one.
    """
    if on_floor[1] > APART:
        return False
    return still is None or still[1] > FIRM or abs(np.log(on_floor[0] / still[0])) < APART


def lengths_across(points: np.ndarray) -> np.ndarray:
    """How long bodies of `points` [F,P,3] m from the camera look [F] m: the spread along their longest axis across the view.

    One that is seen from its end is short, and its distance is hardly known.
    """
    middle = points.mean(1, keepdims=True)
    away = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    about = points - middle
    across = about - (about * away).sum(-1, keepdims=True) * away
    return np.sqrt(np.linalg.eigvalsh(across.mT @ across)[:, -1] / points.shape[1])


def find_floor(
    points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray, feet: np.ndarray, height: np.ndarray, ups: np.ndarray
) -> Plane | None:
    """The plane through SfM `points` [P,3] that are seen near the `feet` [F,N,2] px and lies square to one of `ups` [U,3].

    `height` [F] px is the person's. None where no plane has ENOUGH points: a bare floor, or none in the picture.
    """
    if len(points) < ENOUGH:
        return None
    closest = np.full(len(points), np.inf)
    for i in range(len(viewmats)):
        pixels, z = project(points, viewmats[i], Ks[i])
        away = np.linalg.norm(pixels[:, None] - feet[i], axis=-1).min(1) / height[i]
        closest = np.where(z > 0, np.minimum(closest, away), closest)
    near = points[closest < NEAR_FEET].astype(np.float64)
    if len(near) < ENOUGH:
        return None
    trust = np.exp(-((closest[closest < NEAR_FEET] / (NEAR_FEET / 2)) ** 2))
    centers = camera_centers(viewmats)
    limit = INLIER * np.median(np.linalg.norm(near[:, None] - centers[None, :: max(1, len(centers) // 8)], axis=-1))
    plane = best_plane(near, ups, limit, trust)
    if plane is None:
        return None
    inliers = np.abs(plane.height(near)) < limit
    for _ in range(3):
        if inliers.sum() < ENOUGH:
            return None
        middle = near[inliers].mean(0)
        normal = np.linalg.svd(near[inliers] - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ ups[0])
        inliers = np.abs((near - middle) @ normal) < limit
    return Plane(normal, float(-normal @ middle), int(inliers.sum())) if (ups @ normal > STEEPEST).any() else None


def floor_scale(floor: Plane, soles: np.ndarray, centers: np.ndarray) -> tuple[float, float] | None:
    """Scale, and its relative spread over the frames, at which the lowest of `soles` [F,S,3] m stands SOLE above the floor.

    Soles in metres from the camera, world axes; `centers` [F,3] in SfM units. The scale that most frames agree on (the
    middle of the tightest half), so frames in the air do not count. None if the camera is not above the floor, or too
    few frames show feet.
    """
    drop = -(soles @ floor.normal).min(1)
    above = floor.height(centers)
    usable = (above > 1e-6) & (drop > 0)
    if usable.sum() < max(2, len(drop) // 2):
        return None
    ratios = np.sort((drop[usable] + SOLE) / above[usable])
    half = max(1, len(ratios) // 2)
    start = int((ratios[half - 1 :] - ratios[: len(ratios) - half + 1]).argmin())
    tight = ratios[start : start + half]
    scale = float(np.median(tight))
    return scale, float(np.ptp(tight) / scale)


def still_scale(feet: np.ndarray, centers: np.ndarray, times: np.ndarray) -> tuple[float, float] | None:
    """Scale, and its relative standard error, at which the `feet` [F,2,3] m move least between frames.

    Each foot's steps between frames up to half a second apart, reweighted (L1) so that steps that are really made do not
    count; and only across the view, since depths are an order less sure. None if the camera does not move.
    """
    moves: list[np.ndarray] = []
    shifts: list[np.ndarray] = []
    for gap in range(1, len(times)):
        pairs = np.flatnonzero(times[gap:] - times[:-gap] <= 0.5)
        if not len(pairs):
            break
        away = feet[pairs + gap] + feet[pairs]
        away /= np.linalg.norm(away, axis=-1, keepdims=True)
        move = feet[pairs + gap] - feet[pairs]
        shift = np.broadcast_to((centers[pairs + gap] - centers[pairs])[:, None], move.shape)
        for parts, part in ((moves, move), (shifts, shift)):
            parts.append((part - (part * away).sum(-1, keepdims=True) * away).reshape(-1, 3))
    if not moves:
        return None
    move, shift = np.concatenate(moves), np.concatenate(shifts)
    if (shift**2).sum() == 0:
        return None
    weight = np.ones(len(move))
    for _ in range(30):
        information = (weight * (shift**2).sum(1)).sum()
        scale = -(weight * (move * shift).sum(1)).sum() / information
        left = np.linalg.norm(move + scale * shift, axis=1)
        weight = 1 / np.maximum(left, 0.01)
    error = np.sqrt((weight * left**2).sum() / weight.sum() / max(information / weight.sum(), 1e-18) / len(times))
    return (float(scale), float(error / scale)) if scale > 0 else None

"""Points of the background followed through the clip, and where they are in the world."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stages.avatar.cameras.pinhole import camera_centers
from stages.estimators.corners import Choice
from stages.estimators.corners import follow as follow_corners
from stages.formats.clip import Clip

SIDE = 640  # px of the longer side; larger frames are followed at this size
ALIVE = 500  # points followed at a time
RETURN_PX = 0.3  # how far from its start a point may come back
PERSON = 20  # mask value from which a pixel may be the person's
LEAST = 6  # frames in which a point must be seen before it is placed
ROUNDS = 4  # of Gauss-Newton


@dataclass(frozen=True)
class Tracks:
    """T points in F frames: `pixels` [F,T,2] px of the clip's frames, NaN where a point is not seen.

    `points` [T,3] m is where rays of the given cameras meet best (NaN: too few), `errors` [F,T,2] px is how far the
    pixels lie from there, and `angles` [T] rad the widest angle between two rays.
    """

    pixels: np.ndarray
    points: np.ndarray
    errors: np.ndarray
    angles: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """bool [F,T]."""
        return np.isfinite(self.pixels[..., 0])

    @property
    def lengths(self) -> np.ndarray:
        """In how many frames each point is seen [T]."""
        return self.seen.sum(0)


def follow(clip: Clip) -> Tracks:
    """Follow the background of all frames of `clip` and place what is followed long enough."""
    pixels = _follow(clip)
    pixels = pixels[:, np.isfinite(pixels[..., 0]).sum(0) >= LEAST]
    points, angles = triangulate(pixels, clip.viewmats, clip.Ks)
    return Tracks(pixels, points, pixels - project_with_slopes(points, clip.viewmats, clip.Ks)[0], angles)


def _follow(clip: Clip) -> np.ndarray:
    """Pixels [F,T,2] of corners outside the masks, NaN where they are lost."""
    shrink = min(1.0, SIDE / max(clip.width, clip.height))
    size = round(clip.width * shrink), round(clip.height * shrink)

    def frame(i: int) -> tuple[np.ndarray, np.ndarray]:
        grey = cv2.resize(cv2.cvtColor(clip.images(i), cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        mask = cv2.dilate(cv2.resize(clip.mask(i), size, interpolation=cv2.INTER_AREA), np.ones((9, 9), np.uint8))
        return grey, mask < PERSON

    choice = Choice(most=ALIVE, apart=max(4, max(size) // 60), quality=0.01, returns=RETURN_PX)
    found = follow_corners(map(frame, range(len(clip.names))), choice)
    count = 1 + max((int(rows.max()) for rows, _ in found if len(rows)), default=-1)
    pixels = np.full((len(found), count, 2), np.nan)
    for i, (rows, places) in enumerate(found):
        pixels[i, rows] = (places.astype(np.float64) + 0.5) * [clip.width / size[0], clip.height / size[1]]
    return pixels


def triangulate(pixels: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [T,3] that `pixels` [F,T,2] show best, in least squares of pixels, and their widest angle [T] in rad.

    NaN for points seen fewer than LEAST times or behind a camera.
    """
    seen = np.isfinite(pixels[..., 0])
    rays, centers = bearings(pixels, viewmats, Ks), camera_centers(viewmats)
    A, b = np.zeros((pixels.shape[1], 3, 3)), np.zeros((pixels.shape[1], 3))
    for there, ray, center in zip(seen, rays, centers, strict=True):  # a frame at a time: long clips have many points
        across = np.eye(3) - ray[there, :, None] * ray[there, None, :]
        A[there] += across
        b[there] += across @ center
    usable = seen.sum(0) >= LEAST
    points = np.full((pixels.shape[1], 3), np.nan)
    ridge = 1e-9 * np.eye(3)
    points[usable] = np.linalg.solve(A[usable] + ridge, b[usable][..., None])[..., 0]
    for _ in range(ROUNDS):
        there, z, slopes = project_with_slopes(points, viewmats, Ks)
        errors = np.where(seen[..., None], pixels - there, 0)
        slopes = np.where(seen[..., None, None], slopes, 0)
        usable &= ((z > 0) | ~seen).all(0) & np.isfinite(points).all(1)
        JJ = np.einsum("ftki,ftkj->tij", slopes, slopes)
        step = np.einsum("ftki,ftk->ti", slopes, errors)
        trace = np.trace(JJ[usable], axis1=1, axis2=2)[:, None, None] * 1e-9 * np.eye(3)
        points[usable] += np.linalg.solve(JJ[usable] + trace, step[usable][..., None])[..., 0]
    points[~usable] = np.nan
    return points, _widest_angles(rays, seen)


def bearings(pixels: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """Unit directions [F,T,3] in the world of `pixels` [F,T,2]."""
    x, y = ((pixels[..., k] - Ks[:, k, 2, None]) / Ks[:, k, k, None] for k in (0, 1))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ viewmats[:, :3, :3]
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def project_with_slopes(
    points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [F,T,2] of `points` [T,3], their depths [F,T], and the pixels' slopes [F,T,2,3] by the points.

    Repeats `pinhole.project`, equal but for the last bits, because the slopes need its steps.
    """
    local = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    z = local[..., 2]
    safe = np.where(z > 1e-6, z, np.nan)
    focal = np.stack([Ks[:, 0, 0], Ks[:, 1, 1]], -1)[:, None]
    pixels = focal * local[..., :2] / safe[..., None] + Ks[:, None, :2, 2]
    by_local = np.zeros((*z.shape, 2, 3))
    by_local[..., 0, 0], by_local[..., 1, 1] = focal[..., 0] / safe, focal[..., 1] / safe
    by_local[..., 2] = -focal * local[..., :2] / safe[..., None] ** 2
    return pixels, z, by_local @ viewmats[:, None, :3, :3]


def _widest_angles(rays: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The widest angle [T] in rad between the first, middle and last rays of each point."""
    frames, order = len(rays), np.arange(len(rays))[:, None]
    first, last = np.where(seen, order, frames).min(0), np.where(seen, order, -1).max(0)
    columns = np.arange(rays.shape[1])
    chord = np.linalg.norm(rays[first % frames, columns] - rays[last, columns], axis=1)
    return 2 * np.arcsin((chord / 2).clip(0, 1))

"""Motion of camera and person at a frame, for motion blur and rolling shutter."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import logm
from torch import Tensor

from stages.avatar.cameras.pinhole import project
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats

SWIFT = 0.95  # quantile: a twentieth of what a picture shows is faster


class Around(NamedTuple):
    """The frames before and after one (itself at the ends of a clip), and how many moments lie between the two."""

    before: int
    after: int
    gap: int


def around(moments: np.ndarray, i: int) -> Around:
    """The neighbours in time of frame `i` among frames taken at `moments` int[F], not falling; gap 0 if it has none."""
    earlier, later = np.flatnonzero(moments < moments[i]), np.flatnonzero(moments > moments[i])
    before = int(earlier[-1]) if len(earlier) else i
    after = int(later[0]) if len(later) else i
    return Around(before, after, int(moments[after] - moments[before]))


def drift(viewmats: np.ndarray, near: Around, i: int) -> np.ndarray:
    """The velocity field F [3,4] of the still world seen from camera `i`: X moves by F[:, :3] X + F[:, 3] m a moment.

    viewmats[F,4,4] camera_from_world. F is the matrix logarithm of the motion from one neighbour to the other, exact for
    constant motion; zero where there is no neighbour.
    """
    if not near.gap:
        return np.zeros((3, 4))
    here, before, after = (np.asarray(viewmats[j], np.float64) for j in (i, near.before, near.after))
    return (np.linalg.inv(here) @ logm(after @ np.linalg.inv(before)).real @ here)[:3] / near.gap


class FrameMotion(NamedTuple):
    """How the camera moves at one frame: the velocity `field`[3,4] of `drift`, m a moment.

    K[3,3] px and `height` px are those of the whole frame, at any resolution.
    """

    field: Tensor
    K: Tensor
    height: int

    def past(self, means: Tensor, own: Tensor | None) -> Tensor:
        """Velocities [N,3] past the camera of means[N,3] that move by `own`[N,3] m a moment in the world; None: they stand."""
        past = means @ self.field[:, :3].T + self.field[:, 3]
        return past if own is None else past + own


class Speeds:
    """The motion at each of F frames of a clip: viewmats[F,4,4], Ks[F,3,3] px, `height` px, moments int[F] not falling."""

    def __init__(self, viewmats: np.ndarray, Ks: Tensor, height: int, moments: np.ndarray):
        self.viewmats, self.Ks, self.height, self.moments = viewmats, Ks, height, moments

    def at(self, i: int) -> FrameMotion:
        """How the camera moves at frame `i`."""
        field = torch.as_tensor(drift(self.viewmats, around(self.moments, i), i)).to(self.Ks)
        return FrameMotion(field, self.Ks[i], self.height)

    @torch.no_grad()
    def own(self, i: int, means: Callable[[int], Tensor | None]) -> Tensor | None:
        """Velocities [N,3] m a moment of a person's Gaussians at frame `i`; `means(j)` [N,3] are theirs in frame `j`.

        None where a neighbour has no body fit, so no means: the person stands.
        """
        near = around(self.moments, i)
        if not near.gap or (after := means(near.after)) is None or (before := means(near.before)) is None:
            return None
        return (after - before) / near.gap


def move(splats: Splats, speeds: Tensor, spin: Tensor, times: Tensor) -> Splats:
    """The Gaussians after `times` (one, or [N]) moments of moving by speeds[N,3] and turning by spin[3,3]."""
    at = times.expand(len(splats.means))
    axes = splats.axes + at[:, None, None] * (spin @ splats.axes)
    return splats._replace(means=splats.means + at[:, None] * speeds, axes=axes)


@torch.no_grad()
def px_a_moment(means: Tensor, speeds: Tensor, camera: Camera) -> float:
    """How fast, px a moment, all but the swiftest twentieth of points move across the picture; 0 if it shows none.

    Of means[N,3] m in the world, which move by speeds[N,3] m a moment past the camera, those in the picture count.
    """
    pixels, depths = project(means, camera.viewmat, camera.K)
    size = pixels.new_tensor([camera.width, camera.height])
    shown = (depths > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
    if not shown.any():
        return 0.0
    moving, focal = speeds[shown] @ camera.viewmat[:3, :3].T, camera.K.diagonal()[:2]
    ray = (pixels[shown] - camera.K[:2, 2]) / focal
    across = focal * (moving[:, :2] - ray * moving[:, 2:]) / depths[shown, None]
    return float(across.norm(dim=1).quantile(SWIFT))

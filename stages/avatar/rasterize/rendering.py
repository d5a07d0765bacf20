"""What a rasterizer takes and returns, and the numbers on which all of them agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

BLUR = 0.3
"""px^2 added to each screen covariance, so that no Gaussian falls between pixels (gsplat's eps2d)."""
PIXEL = 0.1
"""BLUR where pictures are antialiased: about a pixel's own variance, 1/12 (Yu et al. 2024, Mip-Splatting)."""
ALPHA_MIN = 1 / 255
"""Fainter than one grey step of an 8-bit picture: left out."""
ALPHA_MAX = 0.999
"""Keeps 1 - alpha away from 0, by which the backward pass divides (gsplat's bound)."""
T_STOP = 1e-4
"""A pixel is finished when less light than this would pass; the Gaussian that would end it is not drawn (gsplat)."""
COMPENSATION_MIN = 0.005
"""Floor of the antialiasing factor sqrt(det0/det), whose slope is infinite at 0 (gsplat)."""
NEAR = 0.01
"""m: the rasterizer draws nothing nearer to the camera, unless it is told another distance."""
FRUSTUM_MARGIN = 0.15
"""Share of the picture's size beyond its border at which the Jacobian's view direction is clamped (hard case A08)."""


LAYERS = 3
"""Pictures that the CPU draws in one pass; more take more passes."""


class Gaussians(NamedTuple):
    """N Gaussians with the colours that one camera sees, in the world, in metres.

    means[N,3]; axes[N,3,3], the scaled axes as columns: the covariance is axes axes^T, so a Gaussian moved by any linear
    blend needs no polar decomposition; opacities[N] in 0..1; colors[N,3]. With `antialias` the screen blur is about a pixel
    wide and lowers opacity as it widens a Gaussian (Mip-Splatting, Yu et al. 2024).
    """

    means: Tensor
    axes: Tensor
    opacities: Tensor
    colors: Tensor
    antialias: bool = False


class Camera(NamedTuple):
    """A pinhole camera: viewmat[4,4] camera_from_world in metres with OpenCV axes (x right, y down, z forward), K[3,3] px,
    the centre of the first pixel at (0.5, 0.5), width and height of its picture in px.

        half = hugs.Camera(camera.viewmat, camera.K / torch.tensor([[2], [2], [1.0]]), camera.width // 2, camera.height // 2)
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    @classmethod
    def of(cls, viewmat: np.ndarray, K: np.ndarray, width: int, height: int) -> Camera:
        """The camera of arrays, in their precision."""
        return cls(torch.as_tensor(viewmat), torch.as_tensor(K), width, height)

    def __repr__(self) -> str:
        view, focal = self.viewmat.detach().cpu().double(), float(self.K[0, 0])
        place = ", ".join(f"{float(x):.2f}" for x in -view[:3, :3].T @ view[:3, 3])
        return f"<camera of {self.width}x{self.height} px, focal length {focal:.0f} px, at ({place}) m>"

    def to(self, like: Tensor) -> Camera:
        """The same camera in the precision and on the device of `like`."""
        return self._replace(viewmat=self.viewmat.to(like), K=self.K.to(like))


class Kept:
    """What a film's last picture leaves for its next: with it a CPU draws again only the blocks of 4x4 px that change."""

    state: Any = None


class Layer(NamedTuple):
    """One picture of a call: which Gaussians (rows[N] bool, None = all), which window of the camera's picture
    (left, top, right, bottom) px (None = all of it), and over which background[3] (None = black).

    `kept` is of the only layer of a call, without rows, window and gradients; colours are then off by half a grey step at most.
    """

    rows: Tensor | None = None
    window: tuple[int, int, int, int] | None = None
    background: Tensor | None = None
    kept: Kept | None = None


@dataclass
class Rendering:
    """One layer's picture of N Gaussians, and what their densification needs.

    image [H,W,3]; alpha [H,W] coverage; depth [H,W] = sum of weight x z (m), all of the layer's window; means2d [N,2] px
    and radii [N] px in the camera's whole picture, radii 0 for Gaussians outside of it or not in the layer. The backward
    pass fills `screen_grad_abs` [N,2], the sum over the layer's pixels of |dL/d means2d|, and `screen_grad` [N,2],
    dL/d means2d of all layers of a pass (LAYERS at most) together. `dropped` counts Gaussians left out because a number
    was not finite.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    means2d: Tensor
    radii: Tensor
    screen_grad: Tensor
    screen_grad_abs: Tensor
    dropped: int

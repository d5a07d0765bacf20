"""What a rasterizer returns, and the numbers on which all of them agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

BLUR = 0.3
"""px^2 added to each screen covariance, so that no Gaussian falls between pixels (gsplat's eps2d)."""
PIXEL = 0.1
"""The same where pictures are antialiased: the spread of a pixel itself, 1/12, about (Yu et al. 2024, Mip-Splatting)."""
ALPHA_MIN = 1 / 255
"""Fainter than one grey step of an 8-bit picture: left out."""
ALPHA_MAX = 0.999
"""Keeps 1 - alpha away from 0, by which the backward pass divides (gsplat's bound)."""
T_STOP = 1e-4
"""A pixel is finished when less light than this would pass; the Gaussian that would end it is not drawn (gsplat)."""
COMPENSATION_MIN = 0.005
"""Floor of the antialiasing factor sqrt(det0/det), whose slope is infinite at 0 (gsplat)."""
FRUSTUM_MARGIN = 0.15
"""Share of the picture's size beyond its border at which the Jacobian's view direction is clamped (hard case A08)."""


LAYERS = 3
"""Pictures that one call can draw."""


class Layer(NamedTuple):
    """One picture of a call: which Gaussians (rows[N] bool, None = all), which window of the camera's picture
    (left, top, right, bottom) px (None = all of it), over which background[3] (None = black), and `stop`, see T_STOP.
    """

    rows: Tensor | None = None
    window: tuple[int, int, int, int] | None = None
    background: Tensor | None = None
    stop: float = T_STOP


@dataclass
class Rendering:
    """One layer's picture of N Gaussians, and what their densification needs.

    image [H,W,3]; alpha [H,W] coverage; depth [H,W] = sum of weight x z (m), all of the layer's window; means2d [N,2] px
    and radii [N] px in the camera's whole picture, radii 0 for Gaussians outside of it or not in the layer. The backward
    pass fills `screen_grad_abs` [N,2], the sum over the layer's pixels of |dL/d means2d|, and `screen_grad` [N,2],
    dL/d means2d of all layers together. `dropped` counts Gaussians left out because a number was not finite.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    means2d: Tensor
    radii: Tensor
    screen_grad: Tensor
    screen_grad_abs: Tensor
    dropped: int

"""What a rasterizer returns, and the numbers on which all of them agree."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

BLUR = 0.3
"""px^2 added to each screen covariance, so that no Gaussian falls between pixels (gsplat's eps2d)."""
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


@dataclass
class Rendering:
    """A picture of N Gaussians and what their densification needs.

    image [H,W,3]; alpha [H,W] coverage; depth [H,W] = sum of weight x z (m); means2d [N,2] px; radii [N] px, 0 where
    nothing was drawn. `screen_grad` [N,2] and `screen_grad_abs` [N,2] are filled by the backward pass: dL/d means2d, and
    the sum over pixels of its absolute values. `dropped` counts Gaussians left out because a number was not finite.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    means2d: Tensor
    radii: Tensor
    screen_grad: Tensor
    screen_grad_abs: Tensor
    dropped: int

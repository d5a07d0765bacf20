"""Motion blur: a picture is the mean, in linear light, of as many pictures as it needs, taken while the shutter is open."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable

import torch
from torch import Tensor

from stages.avatar.body.rotations import constant
from stages.avatar.rasterize import Rendering

MOMENTS = (0.0,), (-(1 / 12**0.5), 1 / 12**0.5), (-(1 / 8**0.5), 0.0, 1 / 8**0.5)
"""When one, two or three pictures are taken, in shares of the open shutter. Two and three are at Chebyshev's points: their mean
is that of all moments up to the third power of time."""
LENGTHS = 1.0, 4.0
"""px of blur up to which one picture is enough, and two: 61 and 56 dB from a mean of 24 in the worst of five frames."""
START = 0.5  # of the time between frames: the usual shutter of films (180 degrees)
OPEN = 0.1  # of the time between frames: one that is open for less gets as many pictures, so that it can open again


class BlurredRendering:
    """The mean of several renderings of one picture; has the fields of `Rendering` that training needs."""

    def __init__(self, draws: list[Rendering]):
        self.draws = draws
        self.image = from_linear(torch.stack([to_linear(one.image) for one in draws]).mean(0))
        self.alpha = torch.stack([one.alpha for one in draws]).mean(0)
        self.depth = torch.stack([one.depth for one in draws]).mean(0)
        self.radii = torch.stack([one.radii for one in draws]).amax(0)
        self.dropped = draws[0].dropped

    @property
    def screen_grad_abs(self) -> Tensor:
        """The sum over all draws, after the backward pass."""
        return torch.stack([one.screen_grad_abs for one in self.draws]).sum(0)


def expose(draw: Callable[[Tensor], list[Rendering]], shutter: Tensor, speed: float) -> list[BlurredRendering]:
    """The layers that `draw` returns for a time, averaged over the share `shutter` [1] of a moment around time 0.

    `speed`, px a moment, is how fast the picture moves; it says how many are drawn.
    """
    count = bisect(LENGTHS, speed * max(float(shutter.detach()), OPEN))
    times = constant(shutter.dtype, shutter.device, *MOMENTS[count])[:, None] * shutter
    return [BlurredRendering(list(draws)) for draws in zip(*(draw(time) for time in times), strict=True)]


def to_linear(value: Tensor) -> Tensor:
    """Light of sRGB values (IEC 61966-2-1); below 0 and above 1 the curve goes on, its slope is never 0 or infinite."""
    high = value > 0.04045
    return torch.where(high, ((torch.where(high, value, 1.0) + 0.055) / 1.055) ** 2.4, value / 12.92)


def from_linear(light: Tensor) -> Tensor:
    """The sRGB values of light, the inverse of `to_linear`."""
    high = light > 0.0031308
    return torch.where(high, 1.055 * torch.where(high, light, 1.0) ** (1 / 2.4) - 0.055, light * 12.92)

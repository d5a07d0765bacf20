"""Shading: the clip's light on the person, by the direction that their surface faces at each Gaussian."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import sh_basis, spread_directions, with_gain

DEGREE = 2  # of the light's log: nine tenths of what a matt surface shows (Ramamoorthi and Hanrahan 2001)
BANDS = (DEGREE + 1) ** 2 - 1  # without the constant, which is the colour itself
HOLD = 1e-3  # weight of the mean square of the log light, so that what no frame tells stays even
STEEPEST = 1.5  # log light is bounded by this: 4.5 times as bright or as dark


class Shading(nn.Module):
    """The log of the light [BANDS,3] in spherical harmonics of the world's directions, a colour each, learned for a clip.

    Colours of the person are then those under light of the same mean from everywhere.
    """

    def __init__(self, bands: Tensor | None = None):
        super().__init__()
        self.bands = nn.Parameter(torch.zeros(BANDS, 3) if bands is None else bands.clone())

    def light(self, towards: Tensor) -> Tensor:
        """Light [N,3] on what faces the unit directions `towards`[N,3], of mean 1 over all directions."""
        around = self._exponent(spread_directions(8 * BANDS).to(self.bands))
        return (self._exponent(towards) - torch.logsumexp(around, 0) + math.log(len(around))).exp()

    def forward(self, person: Splats) -> Splats:
        """The person in this light; the normals get no gradient, ValueError without any.

        Not where each Gaussian itself faces: its shortest axis is noise, by 42 degrees in the median, and so would be its light.
        """
        if person.normals is None:
            raise ValueError("Gaussians without normals face nowhere")
        return person._replace(sh=with_gain(person.sh, self.light(normalize(person.normals.detach(), dim=1))))

    def prior(self) -> Tensor:
        """HOLD x mean square of the bands."""
        return HOLD * self.bands.square().mean()

    def _exponent(self, directions: Tensor) -> Tensor:
        steep = sh_basis(directions, DEGREE)[:, 1:] @ self.bands
        return steep / torch.hypot(torch.ones_like(steep), steep / STEEPEST)  # unlike tanh never flat

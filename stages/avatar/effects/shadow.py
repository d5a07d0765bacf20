"""Cast shadow: one soft ellipsoid for each bone takes light from the scene's Gaussians behind it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import with_gain

DARKNESS, SOFTNESS, DENSITY, SIZE = 0.5, 0.04, 3.0, 0.6  # to begin with
REACH = 3.0  # standard deviations beyond which a bone casts nothing
LEAST = 1e-6  # share of the vertices under which a bone casts nothing
ABOVE = 0.05  # m: width of the sigmoid that tells before from behind


class Casters(NamedTuple):
    """The parts of a body that cast a shadow: middles[J,3] m and covariances[J,3,3] m^2, 0 for a bone without any."""

    middles: Tensor
    covariances: Tensor

    def posed(self, bones: Tensor, transl: Tensor | float = 0.0) -> Casters:
        """Parts moved by bones[J,4,4], then by transl[3] m."""
        turns = bones[:, :3, :3]
        middles = (turns @ self.middles[..., None])[..., 0] + bones[:, :3, 3] + transl
        return Casters(middles, turns @ self.covariances @ turns.mT)


def casters(vertices: Tensor, weights: Tensor) -> Casters:
    """The parts of a body with vertices[V,3] m and skinning weights[V,J].

    They come from the body model: the person's Gaussians are dense where there is much to see, and their learned
    skinning weights do not tell where limbs are; parts made of them miss twice as much of a shadow.
    """
    mass = weights.sum(0)
    kept = mass > LEAST * len(vertices)
    share = weights * (kept / mass.clamp_min(1e-30))
    middles = share.T @ vertices
    away = vertices[:, None] - middles
    return Casters(middles, torch.einsum("vj,vja,vjb->jab", share, away, away))


class Shadow(nn.Module):
    """The shadow of bodies: the direction of the light and four numbers, learned for a clip.

    `slope` [2] tilts the light away from the direction `first` [3]; `darkness` (logit) is the share of all light that
    comes from there, `softness` (log m) the blur of edges, `density` (log) the optical depth through the middle of a
    part, and `size` (log) the share of its covariance that casts: small and dense parts cast an even shadow with a
    sharp edge.
    """

    frame: Tensor

    def __init__(
        self,
        first: Tensor,
        darkness: float = DARKNESS,
        softness: float = SOFTNESS,
        density: float = DENSITY,
        size: float = SIZE,
    ):
        super().__init__()
        self.register_buffer("frame", rotation_z_to(first))
        self.slope = nn.Parameter(torch.zeros(2).to(first))
        self.darkness = nn.Parameter(torch.tensor([darkness]).to(first).logit())
        self.softness = nn.Parameter(torch.tensor([softness]).to(first).log())
        self.density = nn.Parameter(torch.tensor([density]).to(first).log())
        self.size = nn.Parameter(torch.tensor([size]).to(first).log())

    def light(self) -> Tensor:
        """The direction [3] towards the light, of length 1."""
        leaning = torch.cat([self.slope, torch.ones_like(self.slope[:1])])
        return self.frame @ (leaning / leaning.norm())

    def known(self) -> dict[str, Any]:
        """The fields of `records.Effects` about the shadow."""
        found = {name: getattr(self, name).exp().item() for name in ("softness", "density", "size")}
        return found | {"darkness": self.darkness.sigmoid().item(), "light": self.light().detach().cpu().numpy()}

    def _thickness(self, points: Tensor, body: Casters, turn: Tensor) -> Tensor:
        """Optical depth [M] of the posed `body` between the lamp and points[M,3]; `turn` [3,3] takes +z to the light.

        The exponent of a part is a quadratic in x and y across the light, so those of all parts are one product of matrices.
        """
        middle = body.middles.mean(0)  # the quadratics are written about it, lest large terms cancel
        x, y, z = ((points - middle) @ turn).unbind(-1)
        u, v, w = ((body.middles - middle) @ turn).unbind(-1)
        spread = self.size.exp() * (turn.T @ body.covariances @ turn)
        a, b, c = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
        soft = (2 * self.softness).exp()
        det = (a + soft) * (c + soft) - b * b
        xx, xy, yy = -0.5 * (c + soft) / det, b / det, -0.5 * (a + soft) / det
        there = body.covariances.diagonal(dim1=1, dim2=2).sum(1) > 0
        top = torch.where(there, self.density + xx * u * u + xy * u * v + yy * v * v, -torch.inf)
        terms = torch.stack([xx, xy, yy, -2 * xx * u - xy * v, -xy * u - 2 * yy * v, top])
        exponents = torch.stack([x * x, x * y, y * y, x, y, torch.ones_like(x)], 1) @ terms
        return (exponents.exp() * ((w - z[:, None]) / ABOVE).sigmoid()).sum(1)

    def _rows_in_reach(self, points: Tensor, body: Casters, turn: Tensor) -> Tensor:
        """Rows of points[N,3] that any part of the posed `body` may shade; `turn` [3,3] takes +z to the light."""
        with torch.no_grad():
            at, middles = points @ turn, body.middles @ turn
            wide = (self.size.exp() * (turn.T @ body.covariances @ turn)).diagonal(dim1=1, dim2=2)[:, :2].amax()
            reach = REACH * (wide + (2 * self.softness).exp()).sqrt()
            low, high = middles[:, :2].amin(0) - reach, middles[:, :2].amax(0) + reach
            near = (at[:, :2] > low).all(1) & (at[:, :2] < high).all(1)
            return (near & (at[:, 2] < middles[:, 2].amax() + REACH * ABOVE)).nonzero()[:, 0]

    def light_left(self, points: Tensor, bodies: Sequence[Casters]) -> Tensor:
        """Share [N] of the light that reaches points[N,3] m past posed `bodies`, from 1 - darkness to 1.

        What lies behind two is behind more.
        """
        turn = rotation_z_to(self.light())
        reach = [self._rows_in_reach(points, body, turn) for body in bodies]
        thick = [self._thickness(points[rows], body, turn) for rows, body in zip(reach, bodies, strict=True)]
        if len(bodies) == 1:  # the exponential of what is shaded alone
            return torch.ones_like(points[:, 0]).index_put((reach[0],), self._share(thick[0]))
        total = torch.zeros_like(points[:, 0])
        for rows, one in zip(reach, thick, strict=True):
            total = total.index_add(0, rows, one)
        return self._share(total)

    def _share(self, thick: Tensor) -> Tensor:
        return 1 - self.darkness.sigmoid() * (1 - (-thick).exp())

    def forward(self, lit: Splats, bodies: Sequence[Casters]) -> Splats:
        """Gaussians with their colours multiplied by their share of light; without bodies, as they are."""
        if not bodies:
            return lit
        share = self.light_left(lit.means.detach(), bodies)
        return lit._replace(sh=with_gain(lit.sh, share[:, None]))

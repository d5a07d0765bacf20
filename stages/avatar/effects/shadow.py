"""Cast shadow: one soft ellipsoid for each bone takes light from the scene's Gaussians behind it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.kernels import njit, prange
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import with_gain

DARKNESS, SOFTNESS, DENSITY, SIZE = 0.5, 0.04, 3.0, 0.6  # to begin with
REACH = 3.0  # standard deviations beyond which a bone casts nothing
LEAST = 1e-6  # share of the vertices under which a bone casts nothing
ABOVE = 0.05  # m: width of the sigmoid that tells before from behind
ZERO, HALF, ONE, STEEP = np.float32(0), np.float32(0.5), np.float32(1), np.float32(1 / ABOVE)
BEHIND = np.float32(17)  # widths of the sigmoid behind a part, at which it is 1 in float32
FAR = np.float32(40)  # squared standard deviations from a part, at which it takes a billionth


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


class Outline(NamedTuple):
    """A body of J parts as a lamp sees it, z towards the lamp.

    middles[J,3] m; shapes[J,3] in 1/m^2: xx, twice xy and yy of the inverse of the blurred covariance; the optical depth [J]
    through the middle of each; and the `box` [5] beyond which it casts nothing: least x and y, greatest x, y and z, m.
    """

    middles: Tensor
    shapes: Tensor
    density: Tensor
    box: Tensor


def _rows_in(at: Tensor, box: Tensor) -> Tensor:
    """Rows of points at[N,3] m, as the lamp sees them, in a `box` [5] of an outline."""
    return ((at[:, :2] > box[:2]).all(1) & (at < box[2:]).all(1)).nonzero()[:, 0]


def _thickness(points: Tensor, outlines: Sequence[Outline], turn: Tensor) -> Tensor:
    """Optical depth [N] between the lamp and points[N,3] m of `outlines`, as `Shadow._thickness`: float32, CPU, no gradients."""
    total = torch.zeros_like(points[:, 0])
    parts = (torch.stack(list(part)) for part in zip(*outlines, strict=True))
    _thicken(*(part.detach().contiguous().numpy() for part in (points, turn, *parts, total)))
    return total


@njit(cache=True, parallel=True, fastmath={"contract"})
def _thicken(
    points: np.ndarray,
    turn: np.ndarray,
    middles: np.ndarray,
    shapes: np.ndarray,
    density: np.ndarray,
    boxes: np.ndarray,
    total: np.ndarray,
) -> None:
    """Fill total [N] with what lies before points [N,3] of bodies of middles and shapes [B,J,3], density [B,J] and boxes [B,5]."""
    for i in prange(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = px * turn[0, 0] + py * turn[1, 0] + pz * turn[2, 0]
        y = px * turn[0, 1] + py * turn[1, 1] + pz * turn[2, 1]
        z = px * turn[0, 2] + py * turn[1, 2] + pz * turn[2, 2]
        thick = ZERO
        for k in range(len(boxes)):
            box = boxes[k]
            if x > box[0] and y > box[1] and x < box[2] and y < box[3] and z < box[4]:
                for j in range(middles.shape[1]):
                    dx, dy, dz = middles[k, j, 0] - x, middles[k, j, 1] - y, middles[k, j, 2] - z
                    away = shapes[k, j, 0] * dx * dx + shapes[k, j, 1] * dx * dy + shapes[k, j, 2] * dy * dy
                    if density[k, j] > ZERO and away < FAR:
                        behind = dz * STEEP
                        whole = ONE if behind > BEHIND else ONE + np.exp(-behind)
                        thick += density[k, j] * np.exp(-HALF * away) / whole
        total[i] = thick


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

    @torch.no_grad()
    def _outline(self, body: Casters, turn: Tensor) -> Outline:
        """A posed `body` as the lamp sees it; `turn` [3,3] takes +z to the light."""
        middles, soft = body.middles @ turn, (2 * self.softness).exp()
        spread = self.size.exp() * (turn.T @ body.covariances @ turn)
        a, b, c = spread[:, 0, 0] + soft, spread[:, 0, 1], spread[:, 1, 1] + soft
        shapes = torch.stack([c, -2 * b, a], 1) / (a * c - b * b)[:, None]
        there = body.covariances.diagonal(dim1=1, dim2=2).sum(1) > 0
        reach, low, high = REACH * torch.maximum(a, c).amax().sqrt(), middles.amin(0), middles.amax(0)
        box = torch.cat([low[:2] - reach, high[:2] + reach, high[2:] + REACH * ABOVE])
        return Outline(middles, shapes, self.density.exp() * there, box)

    def light_left(self, points: Tensor, bodies: Sequence[Casters]) -> Tensor:
        """Share [N] of the light that reaches points[N,3] m past posed `bodies`, from 1 - darkness to 1.

        What lies behind two is behind more.
        """
        turn = rotation_z_to(self.light())
        outlines = [self._outline(body, turn) for body in bodies]
        learned = torch.is_grad_enabled() and any(part.requires_grad for part in self.parameters())
        if not learned and points.dtype == torch.float32 and points.device.type == "cpu":
            return self._share(_thickness(points, outlines, turn))
        reach = [_rows_in(points.detach() @ turn.detach(), outline.box) for outline in outlines]
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

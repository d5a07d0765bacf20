"""People stand over their feet: where the body's mass is, and how far it lies beside the feet that stand."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from stages.avatar.body.joints import ANKLES, FEET
from stages.estimators.bodyfit.terms import geman_mcclure
from stages.records import JOINT_NAMES

BALANCE, STRIDE = 0.04, 0.5  # m, spread of the mass beside the standing feet; s, half the window of the mean
LOAD = 0.33  # people stand 4 to 5 cm before the ankle (Winter 1995)
GRAVITY = 9.81  # m/s^2
BODY_PARTS = (
    # share of the body's mass, ends, share of the way from the first end to the second
    (0.0694, "neck", "head", 1.0),
    (0.4346, "shoulder", "hip", 0.45),
    (0.0542, "shoulder", "elbow", 0.577),
    (0.0324, "elbow", "wrist", 0.457),
    (0.0122, "wrist", "hand", 1.0),
    (0.2832, "hip", "knee", 0.41),
    (0.0866, "knee", "ankle", 0.446),
    (0.0274, "ankle", "foot", 0.5),
)
"""Of a grown man, both sides together: P. de Leva, "Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters", 1996."""


@cache
def mass_shares() -> Tensor:
    """Weights [24] of the joints whose mean is the body's center of mass; they add up to 1."""
    shares = torch.zeros(len(JOINT_NAMES))
    for mass, first, last, way in BODY_PARTS:
        for end, part in ((first, 1 - way), (last, way)):
            rows = [i for i, name in enumerate(JOINT_NAMES) if name in (end, f"left_{end}", f"right_{end}")]
            shares[rows] += mass * part / len(rows)
    return shares / shares.sum()


def mass_and_soles(placed: Tensor) -> tuple[Tensor, Tensor]:
    """The center of mass [F,3] of joints `placed` [F,24,3] m, and where either foot bears it [F,2,3]."""
    mass = (placed * mass_shares()[:, None]).sum(1)
    return mass, torch.lerp(placed[:, ANKLES], placed[:, FEET], LOAD)


def smooth_acceleration(x: Tensor, times: Tensor, reach: float) -> Tensor:
    """Acceleration [F,3] of `x` [F,3] m at `times` [F] s: of the parabola through each point's neighbours within `reach` s.

    Zero where fewer than five neighbours make one.
    """
    apart = times - times[:, None]
    near = (apart.abs() <= reach).to(x.dtype)
    powers = torch.stack([apart**0, apart, apart**2 / 2], -1)
    normal = torch.einsum("fn,fna,fnb->fab", near, powers, powers)
    right = torch.einsum("fn,fna,nc->fac", near, powers, x)
    enough = near.sum(1) >= 5
    normal = torch.where(enough[:, None, None], normal, torch.eye(3))
    return torch.linalg.solve(normal, right)[:, 2] * enough[:, None]


def balance_cost(placed: Tensor, stands: Tensor, times: Tensor, up: Tensor, up_spread: float, size: Tensor) -> Tensor:
    """Cost of a center of mass beside the standing feet; one number.

    Joints `placed` [F,24,3] m in the world; `stands` [F,2] 0..1; `times` [F] s; `up` [3] is known to `up_spread` rad; `size`
    is the stature over that of the mean body. The mass may stand over any point between the feet; over one foot it stands
    LOAD of the way from ankle to ball. Walkers fall from foot to foot and who starts or stops leans, so the mean over STRIDE
    counts, less what the mass's own acceleration takes: the zero moment point (Vukobratovic 1972).
    """
    mass, soles = mass_and_soles(placed)
    level = torch.eye(3) - up[:, None] * up
    apart, beside = (soles[:, 1] - soles[:, 0]) @ level, (mass - soles[:, 0]) @ level
    along = (beside * apart).sum(-1) / apart.square().sum(-1).clamp(min=1e-6)
    along = torch.minimum(torch.maximum(along, 1 - stands[:, 0]), stands[:, 1]).detach()
    stride = (times[:, None] - times).abs() <= STRIDE
    near = stride * stands.amax(1)
    mean = near @ (beside - along[:, None] * apart) / near.sum(1, keepdim=True).clamp(min=1e-6)
    tall = ((mass - soles.mean(1)) @ up).detach().abs()[:, None]
    pushed = tall / GRAVITY * smooth_acceleration(mass.detach(), times, STRIDE) @ level
    spread = (BALANCE * size) ** 2 + (up_spread * tall[:, 0]) ** 2
    certain = near.sum(1) / stride.sum(1)
    return (certain * geman_mcclure((mean - pushed).square().sum(-1) / spread, 4.0)).sum() / len(mass)

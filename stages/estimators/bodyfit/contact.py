"""The body on the floor: feet that stand do not slide, the lowest of the body touches the floor, nothing sinks into it."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.joints import ANKLES, FEET
from stages.avatar.body.smpl import Body
from stages.avatar.splats.neighbours import farthest_points
from stages.estimators.bodyfit.scale import SOLE
from stages.estimators.bodyfit.terms import geman_mcclure

STILL, GROUND = 0.008, 0.015  # m, a standing foot between two frames, and what touches the floor above it
SLOW = 0.6  # m/s that a foot may move, before the feet are held still, and stand; 0.45 lets one in sixty slide by 2 cm


def stance(feet: Tensor, heights: Tensor | None, times: Tensor, loose: float = 1.0) -> Tensor:
    """Weight [F,2] in 0..1 of each foot as standing: it hardly moves, and is on the floor if the floor is known.

    `feet` [F,2,S,3] m in the world, `heights` [F,2,S] m of the same points over the floor, `times` [F] s. `loose` > 1 widens
    both limits by that factor, for a body whose depth is not settled yet.
    """
    middle = feet.mean(2)
    if len(middle) < 2:
        return middle.new_zeros(middle.shape[:2])
    speed, past = (
        (middle[gap:] - middle[:-gap]).norm(dim=-1) / (times[gap:] - times[:-gap])[:, None]
        for gap in (1, 2)  # past: between the neighbours, in case one frame errs
    )
    slow = torch.cat([speed[:1], torch.minimum(torch.minimum(speed[1:], speed[:-1]), past), speed[-1:]])
    stands = torch.sigmoid((SLOW * loose - slow) / (0.08 * loose))
    if heights is not None:
        lowest = heights.amin(-1)
        stands = stands * torch.sigmoid((0.10 * loose - lowest.abs()) / (0.02 * loose))
        if loose > 1:  # the lower foot
            stands = stands * torch.sigmoid((lowest.flip(1) - lowest + 0.03) / 0.01)
    return stands


def slide_cost(feet: Tensor, stands: Tensor, size: Tensor) -> Tensor:
    """Cost of standing `feet` [F,2,S,3] m that slide; `stands` [F,2] as of `stance`, `size`: stature over the mean body's."""
    pair = (stands[1:] * stands[:-1])[..., None]
    slide = (feet[1:] - feet[:-1]).square().sum(-1) / (STILL * size) ** 2
    return (pair * geman_mcclure(slide, 4.0)).sum() / feet.shape[2] / len(feet)


def floor_cost(feet: Tensor, body: Tensor, stands: Tensor, size: Tensor, loose: float = 1.0) -> Tensor:
    """Cost of standing feet that hover, of soles that sink, and of a body whose lowest point is not on the floor.

    Heights over the floor in m: `feet` [F,2,S], `body` [F,P]; `stands` [F,2]. Who jumps is off the floor, and costs no more
    than 4 standard deviations. `loose` as for `stance`.
    """
    feet, body = ((height - SOLE) / (GROUND * loose * size) for height in (feet, body))
    sunk = geman_mcclure(torch.relu(-feet).square(), 4.0).mean(-1).sum()
    stand = (stands * geman_mcclure(feet.amin(-1).square(), 4.0)).sum()
    touch = geman_mcclure(body.amin(-1).square(), 4.0).sum()
    return (sunk + stand + touch) / len(feet)


def loosen(share: float) -> float:
    """How much wider the limits of a body on the floor are after that `share` of the steps: 6 falling to 1 in the middle."""
    return 1 + 5 * max(0.0, 1 - 2 * share)


def sole_vertices(body: Body, count: int = 8) -> Tensor:
    """Indices [2,count] of vertices spread over the left and the right sole: foot vertices within 12 mm of the lowest."""
    rows = []
    for joints in zip(ANKLES, FEET):
        foot = torch.nonzero(body.lbs_weights[:, joints].sum(1) > 0.5).flatten()
        foot = foot[body.v_template[foot, 1].argsort()]  # the lowest comes first, and is always taken
        foot = foot[body.v_template[foot, 1] < body.v_template[foot[0], 1] + 0.012]
        picked = farthest_points(body.v_template[foot], count)
        rows.append(foot[picked[torch.arange(count) % len(picked)]])
    return torch.stack(rows)

"""How far each joint is probably off, along the view and across it: from how firmly landmarks and limb directions hold it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.estimators.bodyfit.solve import DIRECTION_SHARE, LANDMARK, PRIOR_SHARE, Solver, State

STEP = 0.01  # rad and m, of the differences that stand for slopes
FREE = 1e-3  # information per m^2 and rad^2 that place and turn have without any landmark
# What was measured, over what landmarks that err independently would leave: set on the half of the family for setting and on
# courtyard. Frames help each other, which makes it less; some is common to all frames; and no limb goes farther than its length.
ALONG, ACROSS = 0.6, 0.7
COMMON, LIMB = 0.035, 0.3  # m, along the view; and of a joint that nothing holds


def expected_errors(solver: Solver, state: State) -> np.ndarray:
    """The expected error [F,24,2] m of each joint, one standard deviation along the view and across it.

    Gauss and Newton's information of each frame's pose by landmarks, limb directions and the prior, its inverse carried to the
    joints (Laplace's approximation), times what was measured on clips with truth.
    """
    with torch.no_grad():
        points, joints = solver.pose(state)
        slopes = [_slopes(solver, state, parameter) for parameter in range(6 + state.pose.shape[1])]
        of_points, of_joints = (torch.stack(part, -1) for part in zip(*slopes, strict=True))
        covariance = torch.linalg.inv(_information(solver, state, points, of_points).double())
        spread = torch.einsum("fjca,fab,fjdb->fjcd", of_joints.double(), covariance, of_joints.double())
        away = torch.nn.functional.normalize(joints.double(), dim=-1)
        along = torch.einsum("fjc,fjcd,fjd->fj", away, spread, away)
        across = (spread.diagonal(dim1=-2, dim2=-1).sum(-1) - along).clamp(min=0)
        squared = torch.stack([ALONG**2 * along + COMMON**2, ACROSS**2 * across], -1)
        squared = squared * LIMB**2 / (squared + LIMB**2)
        return squared.sqrt().numpy()


def _slopes(solver: Solver, state: State, parameter: int) -> tuple[Tensor, Tensor]:
    """How landmarks [F,K,3] and joints [F,24,3] move with one parameter of every frame: turn (3), place (3), pose."""
    ends = []
    for sign in (STEP, -STEP):
        change = torch.zeros(len(state.pose), 6 + state.pose.shape[1])
        change[:, parameter] = sign
        turned = State(
            matrix_from_rotvec(change[:, :3]) @ state.root,
            state.place + change[:, 3:6],
            state.pose + change[:, 6:],
            state.betas,
        )
        ends.append(solver.pose(turned))
    points, joints = ((high - low) / (2 * STEP) for high, low in zip(*ends, strict=True))
    return points, joints


def _information(solver: Solver, state: State, points: Tensor, slopes: Tensor) -> Tensor:
    """Information [F,P,P] on the parameters, from `points` [F,K,3] m in camera axes and their `slopes` [F,K,3,P]."""
    z = points[..., 2:, None].clamp(min=0.05)
    focal = solver.K[:, [0, 1], [0, 1]][:, None, :, None]
    pixels = focal * (slopes[:, :, :2] - points[..., :2, None] / z * slopes[:, :, 2:]) / z
    unit = LANDMARK * solver.height[:, None]
    off = ((solver.pixels(points) - solver.xy).norm(dim=-1) / unit).square()
    trust = solver.weight / (1 + off / 25) ** 2 / unit**2  # as much as the robust cost lets a landmark pull where it is
    limbs = points[:, solver.head] - points[:, solver.tail]
    length = limbs.norm(dim=-1, keepdim=True).clamp(min=1e-3)
    along = limbs / length
    moved = slopes[:, solver.head] - slopes[:, solver.tail]
    turned = (moved - along[..., None] * (along[..., None] * moved).sum(2, keepdim=True)) / length[..., None]
    gap = (along - solver.directions(state.bias)).square().sum(-1) / solver.segment_spread**2
    limb_trust = DIRECTION_SHARE * solver.segment_weight / (1 + gap / 9) ** 2 / solver.segment_spread**2
    prior = torch.cat([torch.full((6,), FREE), PRIOR_SHARE / solver.spread.flatten().square()])
    seen = torch.einsum("fk,fkca,fkcb->fab", trust, pixels, pixels)
    return seen + torch.einsum("fs,fsca,fscb->fab", limb_trust, turned, turned) + torch.diag(prior)

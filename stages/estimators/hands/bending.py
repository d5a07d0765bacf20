"""Fingers bent as a hand's points say, frame by frame: least squares on the bones' directions, within what joints can do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from stages.estimators.hands.angles import COUNT, HandAngles
from stages.estimators.hands.network import PALM

CHAINS = ((5, 6, 7, 8), (9, 10, 11, 12), (17, 18, 19, 20), (13, 14, 15, 16), (1, 2, 3, 4))
"""The network's points along each finger, in SMPL-X's order."""
ACROSS, ALONG = 0.15, 0.35  # rad: error of a bone's direction across the view and along it
PRIOR = 0.1  # of the relaxed hand, where the fingers are seen
FAST = 4.0  # rad/s that a finger's joint turns by, one standard deviation
BEYOND = 0.03  # rad past a joint's limit that cost as much as one standard deviation
COUPLED = 0.3  # rad: spread of the last joint's bend about half the middle one's
ROUGH = 0.35  # rms of the directions' residual above which a frame's fingers are no hand's
STEPS, SETTLED = 60, 0.05  # of the solver, and the change of the cost at which it stops
STEP = 0.01  # rad, of the differences that stand for slopes
MIDDLE, LAST = slice(2, 16, 4), slice(3, 16, 4)  # angles of the fingers' middle and last joints


@dataclass(frozen=True)
class BentHands:
    """S right hands through a clip of F frames: `angles` [S,F,21], `turns` [S,F,3,3] of the palms at rest to camera axes, the
    expected error [S,F] m of the joints, and the frames [S,F] in which they fit their points."""

    angles: Tensor
    turns: np.ndarray
    error: np.ndarray
    fits: np.ndarray


def palm_turns(world: np.ndarray, palm: np.ndarray) -> np.ndarray:
    """Rotations [...,3,3] that take a palm at rest [5,3] to the hands' points `world` [...,21,3], in the least squares (Kabsch)."""
    seen = world[..., list(PALM), :]
    seen = seen - seen.mean(-2, keepdims=True)
    u, _, vt = np.linalg.svd(seen.mT @ (palm - palm.mean(0)))
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


def bend(hand: HandAngles, world: np.ndarray, sure: np.ndarray, times: np.ndarray) -> BentHands:
    """Bend right hands as their points `world` [S,F,21,3] m (camera axes) say where they are `sure` [S,F], at `times` [F] s.

    Between and beyond such frames the fingers go on smoothly and relax. Frames whose points no hand can make are left out.
    """
    turns = palm_turns(world, hand.palm)
    bones = np.diff(world[..., np.array(CHAINS), :], axis=-2)
    seen = _tensor(bones / np.linalg.norm(bones, axis=-1, keepdims=True).clip(1e-6))
    turn, gaps = _tensor(turns), _tensor(np.diff(times).clip(1e-3))[:, None]
    angles, fits = hand.relaxed.expand(*sure.shape, COUNT), sure
    for _ in range(2):  # once with all, once without those that do not fit
        known = fits
        angles = _solve(hand, angles, seen, turn, _tensor(known), gaps)
        off = (_predicted(hand, angles, turn) - seen).square().sum(-1).mean((-2, -1)).sqrt()
        fits = sure & (off.numpy() <= ROUGH)
        if np.array_equal(fits, known):
            break
    return BentHands(angles, turns, _errors(hand, angles, turn, _tensor(fits), gaps), fits)


def _predicted(hand: HandAngles, angles: Tensor, turn: Tensor) -> Tensor:
    """Directions [...,5,3,3] of the bones in camera axes."""
    return (turn[..., None, None, :, :] @ hand.directions(angles)[..., None])[..., 0]


def _solve(hand: HandAngles, start: Tensor, seen: Tensor, turn: Tensor, trust: Tensor, gaps: Tensor) -> Tensor:
    """The angles [S,F,21] of least cost, held within their limits."""
    spread = torch.tensor([ACROSS, ACROSS, ALONG])
    loose = 1 - (1 - PRIOR) * trust[..., None]
    angles = start.clone().requires_grad_(True)
    optimizer = torch.optim.LBFGS([angles], max_iter=STEPS, tolerance_change=SETTLED, line_search_fn="strong_wolfe")

    def cost() -> Tensor:
        optimizer.zero_grad()
        off = ((_predicted(hand, angles, turn) - seen) / spread).square().sum(-1)
        total = (trust[..., None, None] * 2 * ((1 + off).sqrt() - 1)).sum()
        past = (hand.low - angles).clamp(min=0) + (angles - hand.high).clamp(min=0)
        for residual in (
            (angles[..., LAST] - 0.5 * angles[..., MIDDLE]) / COUPLED,
            loose.sqrt() * (angles - hand.relaxed) / hand.spread,
            past / BEYOND,
            angles.diff(dim=-2) / gaps / FAST,
        ):
            total = total + residual.square().sum()
        total.backward()
        return total

    optimizer.step(cost)
    return angles.detach().clamp(hand.low, hand.high)


def _errors(hand: HandAngles, angles: Tensor, turn: Tensor, trust: Tensor, gaps: Tensor) -> np.ndarray:
    """The expected error [S,F] m of the bones' ends, the mean over a hand: Laplace's approximation, each frame with its neighbours
    held."""
    changes = STEP * torch.eye(COUNT)[:, None, None]
    ways, ends = (
        (of(angles + changes) - of(angles - changes)) / (2 * STEP)
        for of in (lambda a: _predicted(hand, a, turn), hand.points)
    )
    scaled = (ways / torch.tensor([ACROSS, ACROSS, ALONG])).flatten(3)
    held = torch.nn.functional.pad((gaps * FAST) ** -2, (0, 0, 1, 1))
    known = (1 - (1 - PRIOR) * trust[..., None]) / hand.spread**2 + held[1:] + held[:-1]
    information = trust[..., None, None] * torch.einsum("asfk,bsfk->sfab", scaled, scaled) + torch.diag_embed(known)
    covariance = torch.linalg.inv(information.double())
    squared = torch.einsum("asfnpc,sfab,bsfnpc->sfnp", ends.double(), covariance, ends.double())
    return squared.sqrt().mean((-2, -1)).numpy()


def _tensor(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)

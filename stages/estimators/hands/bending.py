"""Fingers bent as a hand's points say, frame by frame: least squares on the bones' directions, within what joints can do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.estimators.hands.angles import COUNT, HandAngles
from stages.estimators.hands.network import PALM

CHAINS = ((5, 6, 7, 8), (9, 10, 11, 12), (17, 18, 19, 20), (13, 14, 15, 16), (1, 2, 3, 4))
"""The network's points along each finger, in SMPL-X's order."""
ACROSS, ALONG = 0.25, 0.35  # rad: error of a bone's direction across the view and along it
SPOT = 0.005  # m: error of a point across the view
FURTHER = 0.3  # rad by which a palm may face otherwise than its points in space do
PRIOR = 0.2  # of the relaxed hand, where the fingers are seen
FAST = 4.0  # rad/s that a finger's joint turns by, one standard deviation
BEYOND = 0.03  # rad past a joint's limit that cost as much as one standard deviation
COUPLED = 0.3  # rad: spread of the last joint's bend about half the middle one's
ROUGH = 0.012  # m across the view: rms of the residual above which a frame's points are no hand's
STEPS, SETTLED = 60, 0.02  # of the solver, and the change of the cost at which it stops
# Of the expected error; measured on 90 drawn hands by `tests.benchmarks.hands`: joints 1.3 cm off in the median, 1.8 in the mean,
# from 40 px on; a hand at rest would be 1.5 off.
MEASURED = 1.35
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


def bend(
    hand: HandAngles, world: np.ndarray, xy: np.ndarray, scale: np.ndarray, sure: np.ndarray, times: np.ndarray
) -> BentHands:
    """Bend S right hands as the network sees them where they are `sure` [S,F], at `times` [F] s.

    That is in space, `world` [S,F,21,3] m in camera axes, whose depths are rough, and in the picture, `xy` [S,F,21,2] px, where a
    metre has `scale` [S,F] px. Between and beyond sure frames the fingers go on smoothly and relax. Frames whose points no hand
    can make are left out.
    """
    begun = palm_turns(world, hand.palm)
    bones = np.diff(world[..., np.array(CHAINS), :], axis=-2)
    ways = _tensor(bones / np.linalg.norm(bones, axis=-1, keepdims=True).clip(1e-6))
    spots = _tensor(xy[..., np.array(CHAINS), :] / scale[..., None, None, None])
    seen = Seen(
        ways, spots - spots.mean((-3, -2), keepdim=True), _tensor(begun), _tensor(np.diff(times).clip(1e-3))[:, None]
    )
    angles, fits = torch.cat([hand.relaxed.expand(*sure.shape, COUNT), torch.zeros(*sure.shape, 3)], -1), sure
    for _ in range(2):  # once with all, once without those that do not fit
        known = fits
        angles = _solve(hand, angles, seen, _tensor(known))
        bent, turns = angles[..., :COUNT], _turned(angles, seen.turns)
        off = (_spots(hand, _ways(hand, bent, turns), turns) - seen.spots).square().sum(-1).mean((-2, -1)).sqrt()
        fits = sure & (off.numpy() <= ROUGH)
        if np.array_equal(fits, known):
            break
    return BentHands(bent, turns.numpy().astype(np.float64), _errors(hand, bent, turns, _tensor(fits), seen.gaps), fits)


class Seen(NamedTuple):
    """What is seen of S hands in F frames: `ways` [S,F,5,3,3] of the bones, unit, `spots` [S,F,5,4,2] m of their ends across the
    view, about their middle, `turns` [S,F,3,3] of the palms as the points in space have them; `gaps` [F-1,1] s between frames."""

    ways: Tensor
    spots: Tensor
    turns: Tensor
    gaps: Tensor


def _turned(angles: Tensor, turns: Tensor) -> Tensor:
    """The palms' turns [...,3,3]: those seen, and on by the last three of `angles` [...,24]."""
    return matrix_from_rotvec(angles[..., COUNT:]) @ turns


def _ways(hand: HandAngles, angles: Tensor, turn: Tensor) -> Tensor:
    """Directions [...,5,3,3] of the bones in camera axes, of palms turned by `turn` [...,3,3]."""
    return (turn[..., None, None, :, :] @ hand.directions(angles)[..., None])[..., 0]


def _spots(hand: HandAngles, ways: Tensor, turn: Tensor) -> Tensor:
    """Where the ends of bones with directions `ways` [...,5,3,3] are across the view [...,5,4,2] m, about their middle."""
    roots = (turn[..., None, :, :] @ hand.roots[..., None])[..., None, :, 0]
    across = torch.cat([roots, roots + (hand.lengths * ways).cumsum(-2)], -2)[..., :2]
    return across - across.mean((-3, -2), keepdim=True)


def _solve(hand: HandAngles, start: Tensor, seen: Seen, trust: Tensor) -> Tensor:
    """The angles and the palm's further turns [S,F,24] of least cost, the angles held within their limits."""
    spread = torch.tensor([ACROSS, ACROSS, ALONG])
    loose = 1 - (1 - PRIOR) * trust[..., None]
    unit = torch.cat([hand.spread, torch.full((3,), FURTHER)])
    spreads = (start / unit).requires_grad_(True)
    optimizer = torch.optim.LBFGS([spreads], max_iter=STEPS, tolerance_change=SETTLED, line_search_fn="strong_wolfe")

    def cost() -> Tensor:
        optimizer.zero_grad()
        solved = unit * spreads
        angles, further = solved.split([COUNT, 3], -1)
        turn = _turned(solved, seen.turns)
        ways = _ways(hand, angles, turn)
        way = ((ways - seen.ways) / spread).square().sum(-1)
        spot = ((_spots(hand, ways, turn) - seen.spots) / SPOT).square().sum(-1)
        off = (1 + way).sqrt().sum((-2, -1)) + (1 + spot).sqrt().sum((-2, -1))
        total = 2 * (trust * off).sum()
        past = (hand.low - angles).clamp(min=0) + (angles - hand.high).clamp(min=0)
        for residual in (
            (angles[..., LAST] - 0.5 * angles[..., MIDDLE]) / COUPLED,
            loose.sqrt() * (angles - hand.relaxed) / hand.spread,
            past / BEYOND,
            angles.diff(dim=-2) / seen.gaps / FAST,
            further / FURTHER,
        ):
            total = total + residual.square().sum()
        total.backward()
        return total

    optimizer.step(cost)
    solved = unit * spreads.detach()
    return torch.cat([solved[..., :COUNT].clamp(hand.low, hand.high), solved[..., COUNT:]], -1)


def _errors(hand: HandAngles, angles: Tensor, turn: Tensor, trust: Tensor, gaps: Tensor) -> np.ndarray:
    """The expected error [S,F] m of the bones' ends, the mean over a hand: Laplace's approximation, each frame with its neighbours
    held."""
    changes = STEP * torch.eye(COUNT)[:, None, None]
    ways, ends = (
        (of(angles + changes) - of(angles - changes)) / (2 * STEP)
        for of in (lambda a: _ways(hand, a, turn), hand.points)
    )
    scaled = (ways / torch.tensor([ACROSS, ACROSS, ALONG])).flatten(3)
    held = torch.nn.functional.pad((gaps * FAST) ** -2, (0, 0, 1, 1))
    known = (1 - (1 - PRIOR) * trust[..., None]) / hand.spread**2 + held[1:] + held[:-1]
    information = trust[..., None, None] * torch.einsum("asfk,bsfk->sfab", scaled, scaled) + torch.diag_embed(known)
    covariance = torch.linalg.inv(information.double())
    squared = torch.einsum("asfnpc,sfab,bsfnpc->sfnp", ends.double(), covariance, ends.double())
    return MEASURED * squared.sqrt().mean((-2, -1)).numpy()


def _tensor(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)

"""Made hands: the points that the hand network would see of fingers with known angles."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.estimators.hands.angles import COUNT, HandAngles
from stages.estimators.hands.bending import CHAINS
from stages.estimators.hands.clip import right_hand
from stages.estimators.hands.network import POINTS, SeenHand
from stages.estimators.person.crops import Roi
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face

MODEL = read_body_model()
RIG = read_hands_face(MODEL)


@cache
def hand() -> HandAngles:
    """The right hand of the mean body."""
    return right_hand(RIG, MODEL, np.zeros(10))


def waving(frames: int) -> torch.Tensor:
    """Angles [F,21] that swing through most of what joints can do, at 15 frames a second."""
    bones, phases = hand(), torch.rand(COUNT, generator=torch.Generator().manual_seed(0))
    swing = 0.5 + 0.4 * torch.sin(0.15 * torch.arange(frames)[:, None] + 6 * phases)
    angles = bones.low + (bones.high - bones.low) * swing
    angles[:, 3:16:4] = 0.5 * angles[:, 2:16:4]
    return angles


def points(angles: torch.Tensor, noise: float = 0.0) -> np.ndarray:
    """Points [F,21,3] m of a right hand, turned at random, each off by `noise` m."""
    bones, rng = hand(), np.random.default_rng(0)
    found = np.zeros((len(angles), POINTS, 3))
    ends, roots = bones.points(angles).numpy(), [*bones.palm[[1, 2, 4, 3]], bones.palm[1] * [0.4, 1, 1]]
    for finger, chain in enumerate(CHAINS):
        found[:, chain[0]] = roots[finger]
        found[:, list(chain[1:])] = roots[finger] + ends[:, finger]
    turns = Rotation.random(len(angles), random_state=0).as_matrix()
    return np.einsum("fij,fpj->fpi", turns, found) + noise * rng.standard_normal(found.shape)


def seen(x: float, y: float, presence: float = 0.99, side: float = 0.9, size: float = 60.0) -> SeenHand:
    """A hand of `size` px whose wrist is at x, y px, its fingers up."""
    xy = np.array([x, y]) + size * np.linspace([0, 0], [0.3, -1], POINTS)
    return SeenHand(xy, np.zeros((POINTS, 3)), presence, side, Roi(x, y, 2 * size, 0.0))

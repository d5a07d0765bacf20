"""A right hand by 21 angles that its joints can make: bending, spreading, and how the thumb turns.

Each finger has four: how far it is spread and how far it is bent at its three joints; the thumb a turn of its root (3) and the
bending of the other two. Bends are 0 where a finger is straight, and grow towards the palm.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.rotations import cross_matrix, matrix_from_rotvec, rotvec_from_matrix

FINGERS, PARTS = 5, 3  # index, middle, little, ring, thumb: SMPL-X's order
COUNT = 21
# Lowest, highest, relaxed, spread of a finger's four angles, and of the thumb's five (its root's against the rest pose), in rad.
# Ranges of motion as textbooks give them, a little wider; the last joint bends about half as far as the middle one.
FINGER = ((-0.35, 0.35, 0, 0.2), (-0.5, 1.65, 0.35, 0.6), (-0.1, 1.95, 0.5, 0.6), (-0.15, 1.5, 0.3, 0.5))
ROOT = ((-0.8, 0.8, 0, 0.35),) * 3
THUMB = (*ROOT, (-0.3, 1.2, 0.3, 0.4), (-0.3, 1.5, 0.3, 0.4))


class HandAngles:
    """What the angles do to the bones of a hand at rest."""

    def __init__(self, wrist: np.ndarray, joints: np.ndarray, tips: np.ndarray):
        """`wrist` [3], `joints` [15,3] and `tips` [5,3] m of a right hand in the T-pose (it points to -x, its palm to -y), in
        SMPL-X's order."""
        chains = np.concatenate([joints.reshape(FINGERS, PARTS, 3), tips[:, None]], 1) - wrist
        bones = np.diff(chains, axis=1)
        lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
        along = bones / lengths
        self.palm = np.concatenate([np.zeros((1, 3)), chains[[0, 1, 3, 2], 0]])
        """The wrist and where index, middle, ring and little finger begin [5,3] m, from the wrist, as the network has them."""
        self.roots = _tensor(chains[:, 0])
        inward = _unit(np.cross(self.palm[1], self.palm[4]))
        aims, flexes = np.empty((2, FINGERS, 3))
        for finger in range(FINGERS):
            towards = inward if finger < FINGERS - 1 else self.palm[4] - chains[finger, 1]
            aims[finger] = _unit(along[finger, 0] - (along[finger, 0] @ inward) * inward * (finger < FINGERS - 1))
            flexes[finger] = _unit(np.cross(aims[finger], towards))
        side = np.cross(flexes, aims)
        bent = np.arctan2(np.einsum("fpc,fc->fp", along, side), np.einsum("fpc,fc->fp", along, aims))
        bent = np.diff(bent, axis=1, prepend=0)
        rest = np.zeros((FINGERS - 1, 4))
        rest[:, 1:] = bent[: FINGERS - 1]
        self.rest = torch.tensor(np.r_[rest.ravel(), np.zeros(3), bent[-1, 1:]], dtype=torch.float32)
        """The angles [21] of the hand at rest."""
        self.low, self.high, self.relaxed, self.spread = torch.tensor(FINGER * 4 + THUMB, dtype=torch.float32).T
        self.along, self.lengths, self.still = _tensor(along), _tensor(lengths), torch.eye(3)
        self.flexing, self.spreading = cross_matrix(_tensor(flexes))[:, None], cross_matrix(_tensor(inward))

    def turns(self, angles: Tensor) -> Tensor:
        """Turns [...,5,3,3,3] of the joints, each against the bone before it, that give the angles [...,21]."""
        bent = angles - self.rest
        fingers, thumb = bent[..., :16].unflatten(-1, (4, 4)), bent[..., 16:]
        bending = torch.cat([fingers[..., 1:], torch.cat([0 * thumb[..., :1], thumb[..., 3:]], -1)[..., None, :]], -2)
        bending, spread = bending[..., None, None], fingers[..., 0, None, None]
        turns = self.still + bending.sin() * self.flexing + (1 - bending.cos()) * (self.flexing @ self.flexing)
        aside = self.still + spread.sin() * self.spreading + (1 - spread.cos()) * (self.spreading @ self.spreading)
        roots = torch.cat([aside, matrix_from_rotvec(thumb[..., :3])[..., None, :, :]], -3)
        return torch.cat([(roots @ turns[..., 0, :, :])[..., None, :, :], turns[..., 1:, :, :]], -3)

    def directions(self, angles: Tensor) -> Tensor:
        """Directions [...,5,3,3] of the bones, unit, in the axes of the palm at rest."""
        first, middle, last = self.turns(angles).unbind(-3)
        second = first @ middle
        return (torch.stack([first, second, second @ last], -3) @ self.along[..., None])[..., 0]

    def points(self, angles: Tensor) -> Tensor:
        """Ends [...,5,3,3] m of the bones against the roots of their fingers, in the axes of the palm at rest."""
        return (self.lengths * self.directions(angles)).cumsum(-2)

    def rotvecs(self, angles: Tensor) -> Tensor:
        """The turns [...,15,3] rad as SMPL-X takes them."""
        return rotvec_from_matrix(self.turns(angles)).flatten(-3, -2)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _tensor(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)

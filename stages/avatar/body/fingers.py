"""Finger bones on an SMPL body: 15 a hand, in SMPL-X's order and axes, hanging on the joints 22 and 23 that SMPL has for a hand.

A pose of hands is [...,2,15,3] rad: of the left and of the right hand index, middle, pinky, ring and thumb, three bones each
from the palm on. All 0 is the body's hand at rest: the free body's is relaxed, with fingers a little bent. `flat_hands` is the flat
hand at which SMPL-X and AMASS have their 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from stages import gestures
from stages.avatar.body.joints import HANDS
from stages.avatar.body.rotations import matrix_from_rotvec, rotvec_from_matrix
from stages.avatar.body.smpl import affine

BONES = len(gestures.FINGER_NAMES)
THUMB = 4  # of the five fingers: SMPL-X's rests as the free body's


def finger_joints(rig: gestures.HandsFace, vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Joints [...,30,3] and tips [...,10,3] m of fingers at rest, from a body's `vertices` [...,V,3] at rest."""
    regressor = torch.as_tensor(rig.finger_regressor).to(vertices)
    joints, tips = (regressor @ vertices).split([BONES, len(regressor) - BONES], -2)
    return joints, tips


def finger_bones(joints: Tensor, hands: Tensor, bones: Tensor) -> Tensor:
    """Transforms [...,30,4,4] of the fingers from rest to `hands` [...,2,15,3] rad, on a body whose `bones` [...,24,4,4] are those
    of `rest_relative_transforms`; fingers rest at `joints` [30,3] m. Differentiable in all three.
    """
    turns = matrix_from_rotvec(hands).flatten(-4, -3)
    own = affine(turns, joints - (turns @ joints[..., None])[..., 0]).unflatten(-3, (2, 5, 3))
    first = bones[..., list(HANDS), None, :, :] @ own[..., 0, :, :]
    second = first @ own[..., 1, :, :]
    return torch.stack([first, second, second @ own[..., 2, :, :]], -3).flatten(-5, -3)


def bent_skin(rig: gestures.HandsFace, vertices: Tensor, hands: Tensor) -> Tensor:
    """A body's `vertices` [V,3] at rest with its fingers in a pose of `hands` [2,15,3] rad."""
    own = torch.as_tensor(rig.finger_weights).to(vertices)
    joints, _ = finger_joints(rig, vertices)
    moved = finger_bones(joints, hands, torch.eye(4).to(vertices).expand(24, 4, 4))[:, :3].flatten(1)
    blend = (own @ moved).unflatten(1, (3, 4))
    return (1 - own.sum(1, keepdim=True)) * vertices + (blend[..., :3] @ vertices[..., None])[..., 0] + blend[..., 3]


def flat_hands(joints: Tensor, tips: Tensor) -> Tensor:
    """The pose [2,15,3] rad in which fingers that rest at `joints` [30,3], `tips` [10,3] m, are straight in the palm's plane."""
    above, own = _straightening(joints, tips)
    return rotvec_from_matrix(above.mT @ own)


def from_flat(hands: Tensor, joints: Tensor, tips: Tensor) -> Tensor:
    """Poses [...,2,15,3] rad of fingers that are flat at 0, as SMPL-X's and AMASS' are, as poses of these."""
    above, own = _straightening(joints, tips)
    return rotvec_from_matrix(above.mT @ matrix_from_rotvec(hands) @ own)


def _straightening(joints: Tensor, tips: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations [2,15,3,3] of the bone above each bone, and of each bone, from rest to a flat hand, as the palm sees them."""
    points = torch.cat([joints.reshape(10, 3, 3), tips[:, None]], 1)
    ways = torch.nn.functional.normalize(points.diff(dim=1), dim=-1)  # [10,3,3]
    flat = torch.nn.functional.normalize(ways * ways.new_tensor([1, 0, 1]), dim=-1)  # palms look down
    axes = torch.linalg.cross(ways, flat)
    angles = torch.atan2(axes.norm(dim=-1, keepdim=True), (ways * flat).sum(-1, keepdim=True))
    turns = matrix_from_rotvec(torch.nn.functional.normalize(axes, dim=-1) * angles).reshape(2, 5, 3, 3, 3)
    still = torch.eye(3).to(turns).expand(2, 1, 3, 3, 3)
    turns = torch.cat([turns[:, :THUMB], still], 1)
    above = torch.cat([still.expand(2, 5, 3, 3, 3)[:, :, :1], turns[:, :, :-1]], 2)
    return above.flatten(1, 2), turns.flatten(1, 2)

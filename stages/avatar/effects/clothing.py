"""Bones of their own for cloth and hair: the skeleton carries them, and they swing beyond it.

Game characters have such bones for skirts and hair; ReLoo (https://arxiv.org/abs/2409.15269) learns them from video. A bone
is carried by a blend of the skeleton's, so without a swing it moves like the skin around. Its swing, a turn and a shift
in the rest pose, is linear in features of the pose, principal components of the training poses, which are held within
what training saw, so that nothing new makes clothes explode. Posing stays skinning.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from stages import records
from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import affine
from stages.avatar.splats.neighbours import farthest_points

BONES = 24  # at most
APART = 0.1  # m between bones, at least
BELL = 0.9  # of the distance between bones: sigma of a bone's share
LOOSE = (0.02, 0.06)  # m off the skin between which cloth changes from the skeleton's bones to its own
FEATURES = 6
PRIOR = 0.1  # weight of the mean squared swing
UNITS = (0.3, 0.3, 0.3, 0.05, 0.05, 0.05)  # rad, m: a usual swing


class Hung(NamedTuple):
    """Where K bones hang: `centres` [K,3] m at rest, and `carriers` [K,24], the share that each of the skeleton's carries."""

    centres: Tensor
    carriers: Tensor


class Clothing(nn.Module):
    """K bones at `centres` [K,3] m at rest, carried by `carriers` [K,24] of the skeleton's.

    Their swing in UNITS is swings[K,6,1+Q] @ features. Features [1+Q] of a body pose are 1 and (pose - mean[69]) @
    axes[69,Q], within low and high[Q].
    """

    centres: Tensor
    carriers: Tensor
    mean: Tensor
    axes: Tensor
    low: Tensor
    high: Tensor
    units: Tensor

    def __init__(self, swings: Tensor, **fixed: Tensor):
        super().__init__()
        for name, value in fixed.items():
            self.register_buffer(name, value)
        self.register_buffer("units", torch.tensor(UNITS).to(swings), persistent=False)
        self.swings = nn.Parameter(swings)

    @classmethod
    def start(cls, hung: Hung, poses: Tensor) -> Clothing:
        """Bones that follow the skeleton, and the features of the training frames' body poses[F,69] in rad."""
        mean = poses.mean(0)
        _, spread, axes = torch.linalg.svd((poses - mean).double(), full_matrices=False)
        kept = (spread[:FEATURES] > 1e-3 * len(poses) ** 0.5).sum()
        axes = (axes[:kept] / spread[:kept, None] * len(poses) ** 0.5).T.to(poses)  # features of variance 1
        features = (poses - mean) @ axes
        count = len(hung.centres)
        return cls(
            poses.new_zeros(count, 6, 1 + int(kept)),
            **hung._asdict(),
            mean=mean,
            axes=axes,
            low=features.amin(0),
            high=features.amax(0),
        )

    @classmethod
    def of(cls, clothes: records.Clothes) -> Clothing:
        """Trained clothes, float32, as constants."""
        arrays = {name: torch.as_tensor(array, dtype=torch.float32) for name, array in vars(clothes).items()}
        return cls(**arrays).requires_grad_(False)

    def __len__(self) -> int:
        return len(self.centres)

    def features(self, body_pose: Tensor) -> Tensor:
        """Features [...,1+Q] of poses [...,69] in rad, clamped to the limits of training."""
        principal = ((body_pose - self.mean) @ self.axes).clamp(self.low, self.high)
        return torch.cat([torch.ones_like(body_pose[..., :1]), principal], -1)

    def swing(self, body_pose: Tensor) -> Tensor:
        """The bones' swing [K,6] in UNITS in one pose [69]."""
        return self.swings @ self.features(body_pose)

    def carried(self, bones: Tensor) -> Tensor:
        """Transforms [...,K,4,4] by which the skeleton's bones[...,24,4,4] carry those here."""
        return (self.carriers @ bones.flatten(-2)).unflatten(-1, (4, 4))

    def hang(self, bones: Tensor, swing: Tensor | None = None) -> Tensor:
        """All transforms [24+K,4,4] from rest: those of the skeleton's `bones`[24,4,4], then of those here, with a swing [K,6]."""
        carried = self.carried(bones)
        if swing is not None:
            moved = swing * self.units
            turn = matrix_from_rotvec(moved[:, :3])
            shift = self.centres - (turn @ self.centres[..., None])[..., 0] + moved[:, 3:]
            carried = carried @ affine(turn, shift)
        return torch.cat([bones, carried])

    def prior(self) -> Tensor:
        """The regularizer PRIOR x mean squared swing for a feature of one: it lets clothes follow the body."""
        return PRIOR * self.swings.square().sum() / max(1, self.swings.numel())


def bones_for(points: Tensor, away: Tensor, weights: Tensor) -> tuple[Hung, Tensor]:
    """Bones for cloth at points[C,3] m at rest, away[C] m off the skin, that spreads weights[C,24] there.

    Also the weights [C,24+K] of the cloth with them: its own bones have what is LOOSE, by a bell around each.
    """
    loose = ((away - LOOSE[0]) / (LOOSE[1] - LOOSE[0])).clamp(0, 1)
    free = (loose > 0.5).nonzero()[:, 0]
    if len(free) == 0:
        return Hung(points[free], weights[free]), weights
    chosen = free[farthest_points(points[free], BONES)]
    before = torch.cdist(points[chosen], points[chosen]).tril(-1)
    before[before == 0] = torch.inf
    chosen = chosen[before.amin(1) > APART]
    gaps = torch.cdist(points, points[chosen])
    gap = gaps[free].amin(1).max().clamp_min(0.5 * APART)
    bells = torch.exp(-0.5 * (gaps / (BELL * gap)).square())
    own = loose[:, None] * bells / bells.sum(1, keepdim=True).clamp_min(1e-12)
    rest = (1 - own.sum(1, keepdim=True)).clamp_min(0)
    return Hung(points[chosen], weights[chosen]), torch.cat([weights * rest, own], 1)

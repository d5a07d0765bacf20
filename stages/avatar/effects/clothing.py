"""Bones of their own for cloth and hair: the skeleton carries them, and they swing beyond it.

Game characters have such bones for skirts and hair; ReLoo (https://arxiv.org/abs/2409.15269) learns them from video. A bone
is carried by a blend of the skeleton's. A leg pushes cloth that it moves towards and does not pull what it moves away from:
that hangs below the pelvis, so the back of a coat does not go up with the knees. Its swing, a turn and a shift
in the rest pose, is linear in features of the pose, principal components of the training poses. A pose that is unlike
all that training saw tells nothing of a swing: there clothes have the mean one. Posing stays skinning.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from stages import records
from stages.avatar.body.joints import ANKLES, FEET, HIPS, KNEES, SPINE
from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import affine
from stages.avatar.splats.neighbours import farthest_points

BONES = 24  # at most
APART = 0.1  # m between bones, at least
BELL = 0.9  # of the distance between bones: sigma of a bone's share
LOOSE = (0.02, 0.06)  # m off the skin between which cloth changes from the skeleton's bones to its own
FEATURES = 6
UNLIKE = 0.5  # of what training saw of a feature: a pose that is so far beyond is like none of the training
PRIOR = 0.1  # weight of the mean squared swing
UNITS = (0.3, 0.3, 0.3, 0.05, 0.05, 0.05)  # rad, m: a usual swing
LEGS = tuple(zip(HIPS, KNEES, ANKLES, FEET))
THIGHS = slice(HIPS[0], HIPS[-1] + 1)  # their rows among bones
BALANCE = {0: 0.5, SPINE[2]: 0.5, ANKLES[0]: -0.5, ANKLES[1]: -0.5}  # joints whose sum is the way up
PUSHED = 0.2  # of its length that a thigh moves: from there on cloth straight before it goes with it all the way
OVER = 1e-3  # 1 + cosine between how a pelvis points and what is up: less would turn it to any side
FOLDED = 0.3  # m from the ankles to the trunk, below which they tell less of what is up


class Hung(NamedTuple):
    """Where K bones hang: `centres` [K,3] m at rest, and `carriers` [K,24], the share that each of the skeleton's carries."""

    centres: Tensor
    carriers: Tensor


class Clothing(nn.Module):
    """K bones at `centres` [K,3] m at rest, carried by `carriers` [K,24] of the skeleton's, whose `joints` [24,3] m are at rest.

    Their swing in UNITS is swings[K,6,1+Q] @ features. Features [1+Q] of a body pose are 1 and (pose - mean[69]) @
    axes[69,Q], held within low and high[Q], and fading to 0 where the pose is `UNLIKE` those of training.
    """

    centres: Tensor
    carriers: Tensor
    joints: Tensor
    mean: Tensor
    axes: Tensor
    low: Tensor
    high: Tensor
    units: Tensor
    room: Tensor  # [Q] how far beyond low and high a feature fades
    legs: Tensor  # [2,24], 1 where a bone is of that leg
    thighs: Tensor  # [2,3] where each thigh points at rest
    ways: Tensor  # [2,K,3] level directions from each hip to the bones
    balance: Tensor  # [24,1,4] what each bone adds to the way from between the ankles to the trunk, by (x, y, z, 1)
    above: Tensor  # [3] that way at rest, of length 1

    def __init__(self, swings: Tensor, **fixed: Tensor):
        super().__init__()
        for name, value in fixed.items():
            self.register_buffer(name, value)
        self.swings = nn.Parameter(swings)
        joints, found = self.joints, {"units": torch.tensor(UNITS).to(swings)}
        found["room"] = (UNLIKE * (self.high - self.low)).clamp_min(1e-9)
        found["legs"] = swings.new_zeros(2, len(joints))
        for side, leg in enumerate(LEGS):
            found["legs"][side, list(leg)] = 1
        found["thighs"] = F.normalize(joints[list(KNEES)] - joints[THIGHS], dim=1)
        found["ways"] = F.normalize((self.centres - joints[THIGHS, None]) * joints.new_tensor([1, 0, 1]), dim=2)
        found["balance"] = joints.new_zeros(len(joints), 1, 4)
        for joint, share in BALANCE.items():
            found["balance"][joint, 0] = share * F.pad(joints[joint], (0, 1), value=1)
        found["above"] = F.normalize(found["balance"][..., :3].sum((0, 1)), dim=0)
        for name, value in found.items():
            self.register_buffer(name, value, persistent=False)

    @classmethod
    def start(cls, hung: Hung, joints: Tensor, poses: Tensor) -> Clothing:
        """Bones that follow the skeleton of joints[24,3], and the features of the training frames' body poses[F,69] in rad."""
        mean = poses.mean(0)
        _, spread, axes = torch.linalg.svd((poses - mean).double(), full_matrices=False)
        kept = (spread[:FEATURES] > 1e-3 * len(poses) ** 0.5).sum()
        axes = (axes[:kept] / spread[:kept, None] * len(poses) ** 0.5).T.to(poses)  # features of variance 1
        features = (poses - mean) @ axes
        count = len(hung.centres)
        return cls(
            poses.new_zeros(count, 6, 1 + int(kept)),
            **hung._asdict(),
            joints=joints,
            mean=mean,
            axes=axes,
            low=features.amin(0),
            high=features.amax(0),
        )

    @classmethod
    def of(cls, clothes: records.Clothes, joints: np.ndarray) -> Clothing:
        """Trained clothes of an avatar with these joints[24,3], float32, as constants."""
        arrays = vars(clothes) | {"joints": joints}
        tensors = {name: torch.as_tensor(array, dtype=torch.float32) for name, array in arrays.items()}
        return cls(**tensors).requires_grad_(False)

    def moved(self, joints: Tensor, centres: Tensor) -> Clothing:
        """The same clothes on joints[24,3] m that are elsewhere at rest, their bones at centres[K,3] m; differentiable in both."""
        same = {name: getattr(self, name) for name in ("carriers", "mean", "axes", "low", "high")}
        return Clothing(self.swings, joints=joints, centres=centres, **same).requires_grad_(self.swings.requires_grad)

    def __len__(self) -> int:
        return len(self.centres)

    def features(self, body_pose: Tensor) -> Tensor:
        """Features [...,1+Q] of poses [...,69] in rad: 1, then those that fade where one is beyond the limits of training."""
        principal = (body_pose - self.mean) @ self.axes
        held = principal.clamp(self.low, self.high)
        beyond = (principal - held).abs() / self.room
        like = 1 - F.pad(beyond, (0, 1)).amax(-1, keepdim=True).clamp_max(1)
        return torch.cat([torch.ones_like(like), held * like], -1)

    def swing(self, body_pose: Tensor) -> Tensor:
        """The bones' swing [...,K,6] in UNITS in poses [...,69]."""
        return (self.swings @ self.features(body_pose)[..., None, :, None])[..., 0]

    def carried(self, bones: Tensor) -> Tensor:
        """Transforms [...,K,4,4] by which the skeleton's bones[...,24,4,4] carry those here.

        Of a leg's share what does not push the cloth hangs from the `upright` pelvis.
        """
        shares = self.carriers * self.pushed(bones)
        hanging = (self.carriers - shares).sum(-1, keepdim=True)
        upright = self.upright(bones)[..., None, :, :]
        return (shares @ bones.flatten(-2) + hanging * upright.flatten(-2)).unflatten(-1, (4, 4))

    def pushed(self, bones: Tensor) -> Tensor:
        """How far the bones here go with each of the skeleton's bones[...,24,4,4]: [...,K,24] from 0 to 1.

        With a leg it is how straight its thigh has moved towards them from where it is at rest, seen from the pelvis: the cosine
        between that way and theirs, on the level. Else 1.
        """
        pointing = (bones[..., THIGHS, :3, :3] @ self.thighs[..., None])[..., 0]
        moved = pointing @ bones[..., 0, :3, :3] - self.thighs  # as the pelvis sees it
        far = moved[..., ::2].norm(dim=-1, keepdim=True).clamp_min(PUSHED)
        away = 1 - ((self.ways @ moved[..., None])[..., 0] / far).clamp(0, 1)  # [...,2,K]
        return 1 - away.mT @ self.legs

    def upright(self, bones: Tensor) -> Tensor:
        """The transform [...,4,4] of the pelvis of the skeleton's bones[...,24,4,4], turned by the least so that it is upright.

        No pose says where down is, but who stands is balanced above the feet: up is from between the ankles to the trunk.
        """
        pelvis, above = bones[..., 0, :3, :3], (bones[..., :3, :] * self.balance).sum((-3, -1))
        points, far = pelvis @ self.above, above.norm(dim=-1, keepdim=True)
        up = points * (1 - far / FOLDED).clamp_min(0) + above / far.clamp_min(FOLDED)
        up = up / up.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        turn = up[..., None] * points[..., None, :]
        near = (1 + turn.diagonal(0, -2, -1).sum(-1)).clamp_min(OVER)[..., None, None]
        cross = turn - turn.mT  # the matrix of points x up
        side = cross @ pelvis
        more = side + cross @ side / near
        return affine(pelvis + more, bones[..., 0, :3, 3] - more @ self.joints[0])

    def hang(self, bones: Tensor, swing: Tensor | None = None) -> Tensor:
        """All transforms [...,24+K,4,4] from rest: of the skeleton's `bones`[...,24,4,4], then of those here, with a swing
        [...,K,6].
        """
        if swing is None:
            return torch.cat([bones, self.carried(bones)], -3)
        turns, shifts = (swing * self.units).split(3, -1)
        return self.swung(bones, matrix_from_rotvec(turns), shifts)

    def swung(self, bones: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
        """The same with a swing in turns [...,K,3,3] and shifts [...,K,3] m."""
        places = self.centres - (turns @ self.centres[..., None])[..., 0] + shifts
        return torch.cat([bones, self.carried(bones) @ affine(turns, places)], -3)

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

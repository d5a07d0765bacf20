"""What clothes did in the frames becomes what they do: how their swing follows the pose and the sway of springs."""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy.optimize import nnls
from torch import Tensor

from stages.avatar.body.rotations import rotvec_from_matrix
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.spring import sways

OFF = 0.15  # m around a bone's centre at which it is told what carries it
STAY = 1e-3  # m^2 in each frame: pull of a bone's carriers to those that spread from the skin
FULL = 10.0  # weight of the sum of a bone's carriers, which is one
RIDGES = (1.0, 3.0, 10.0, 30.0, 100.0, 1e9)  # frames that say that nothing swings; with the last nothing does
FREE, DAMPING = (4.0, 6.0, 9.0, 13.0), (0.15, 0.35, 0.7)  # rad/s, share of critical: springs that are tried
PARTS = 4  # of the clip, each told from the others
GAIN = 0.05  # share of the squared error that a spring must take away


class Course(NamedTuple):
    """How the skeleton goes through the F frames of a clip: bones[F,24,4,4], transl[F,3] m, body_pose[F,69], times[F] s."""

    bones: Tensor
    transl: Tensor
    body_pose: Tensor
    times: Tensor


@torch.no_grad()
def fit_swing(clothing: Clothing, table: Tensor, trained: Tensor, course: Course) -> float:
    """Fit `clothing` in place to the swing table[F,K,6] that the frames trained[F] have on top of it.

    Returns the share of the squared swing that it does not tell, each part of the clip told from the others.
    """
    features = clothing.features(course.body_pose)
    swing = ((clothing.swings @ features.T).permute(2, 0, 1) + table)[trained]
    wanted = _carry_anew(clothing, course.bones[trained], swing)
    alone = features[trained][:, None].expand(-1, len(clothing), -1)
    best, (error, ridge) = None, _best_ridge(alone, wanted)
    limit = (1 - GAIN) * error
    for free in FREE:
        for damping in DAMPING:
            clothing.spring.copy_(torch.tensor([free, damping]))
            sway = torch.stack(list(sways(clothing, course.bones, course.transl, course.times)))
            found, pull = _best_ridge(torch.cat([alone, sway[trained]], 2), wanted)
            if found < min(error, limit):
                best, error, ridge = (free, damping, sway), found, pull
    told = alone if best is None else torch.cat([alone, best[2][trained]], 2)
    fitted = _ridge(told, wanted, ridge)
    count = features.shape[1]
    clothing.swings.copy_(fitted[..., :count])
    if best is not None:
        clothing.spring.copy_(torch.tensor(best[:2]))
        clothing.sways.copy_(fitted[..., count:])
        clothing.reach.copy_(best[2].norm(dim=2).amax(0))
    return error / float(wanted.square().mean().clamp_min(1e-12))


def _carry_anew(clothing: Clothing, bones: Tensor, swing: Tensor) -> Tensor:
    """Let those of the skeleton carry that move most like the clothes in F frames; returns the swing[F,K,6] that is left.

    A bag hangs from the pelvis however near the leg. Points around a bone's centre tell, OFF m from it.
    """
    moved = torch.stack([clothing.hang(one, by)[len(one) :] for one, by in zip(bones, swing)])  # [F,K,4,4]
    around = OFF * torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(moved)
    points = clothing.centres[:, None] + around
    wanted = torch.einsum("fkab,kpb->kfpa", moved[..., :3, :3], points) + moved.permute(1, 0, 2, 3)[:, :, None, :3, 3]
    found = torch.einsum("fjab,kpb->kfpaj", bones[..., :3, :3], points) + bones[None, :, None, :, :3, 3].mT
    count, pull = len(moved), (STAY * len(moved)) ** 0.5
    for k in range(len(clothing)):
        before = clothing.carriers[k]
        rows = [
            found[k].reshape(-1, found.shape[-1]),
            pull * torch.eye(len(before)),
            FULL * count * torch.ones(1, len(before)),
        ]
        told = [wanted[k].reshape(-1), pull * before, FULL * count * torch.ones(1)]
        share, _ = nnls(torch.cat(rows).double().numpy(), torch.cat(told).double().numpy())
        clothing.carriers[k] = torch.as_tensor(share / share.sum()).to(before)
    carried = clothing.carried(bones)
    left = torch.linalg.solve(carried, moved)
    turn, _, other = torch.linalg.svd(left[..., :3, :3])
    turn = turn @ other
    shift = (left[..., :3, :3] @ clothing.centres[..., None])[..., 0] + left[..., :3, 3] - clothing.centres
    return torch.cat([rotvec_from_matrix(turn), shift], -1) / clothing.units


def _best_ridge(told: Tensor, wanted: Tensor) -> tuple[float, float]:
    """The least error of `_untold`, and the pull of RIDGES that has it."""
    return min((_untold(told, wanted, ridge), ridge) for ridge in RIDGES)


def _ridge(told: Tensor, wanted: Tensor, ridge: float) -> Tensor:
    """Factors [K,6,R] that take told[F,K,R] to wanted[F,K,6], pulled to 0; each of R by its own size."""
    x, y = told.permute(1, 0, 2).double(), wanted.permute(1, 0, 2).double()
    size = x.square().mean(1, keepdim=True).sqrt().clamp_min(1e-9)
    x = x / size
    eye = ridge * torch.eye(x.shape[2], dtype=x.dtype)
    eye[0, 0] = 1e-6  # the first is 1: what clothes do on average is their shape
    found = torch.linalg.solve(x.mT @ x + eye, x.mT @ y) / size.mT
    return found.mT.to(told)


def _untold(told: Tensor, wanted: Tensor, ridge: float) -> float:
    """Mean squared error of PARTS of the clip, each told from the others."""
    part = torch.arange(len(told)) * PARTS // len(told)
    errors = []
    for i in range(PARTS):
        factors = _ridge(told[part != i], wanted[part != i], ridge)
        errors.append((torch.einsum("kor,fkr->fko", factors, told[part == i]) - wanted[part == i]).square())
    return float(torch.cat(errors).mean())

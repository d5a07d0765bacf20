"""What clothes did in the frames becomes what they do: how their swing follows the pose."""

from __future__ import annotations

import torch
from scipy.optimize import nnls
from torch import Tensor

from stages.avatar.body.rotations import rotvec_from_matrix
from stages.avatar.effects.clothing import Clothing

OFF = 0.15  # m around a bone's centre at which it is told what carries it
STAY = 1e-3  # m^2 in each frame: pull of a bone's carriers to those that spread from the skin
FULL = 10.0  # weight of the sum of a bone's carriers, which is one
RIDGES = (1.0, 3.0, 10.0, 30.0, 100.0, 1e9)  # frames that say that nothing swings; with the last nothing does
PARTS = 4  # of the clip, each told from the others


@torch.no_grad()
def fit_swing(clothing: Clothing, table: Tensor, trained: Tensor, bones: Tensor, body_pose: Tensor) -> float:
    """Fit `clothing` in place to the swing table[F,K,6] that the frames trained[F] have on top of it.

    In the F frames the skeleton has bones[F,24,4,4] in the poses body_pose[F,69]. Returns the share of the squared swing that
    the pose does not tell, each part of the clip told from the others.
    """
    features = clothing.features(body_pose)
    swing = ((clothing.swings @ features.T).permute(2, 0, 1) + table)[trained]
    wanted, told = _carry_anew(clothing, bones[trained], swing), features[trained]
    error, ridge = min((_untold(told, wanted, ridge), ridge) for ridge in RIDGES)
    clothing.swings.copy_(_ridge(told, wanted, ridge))
    return error / float(wanted.square().mean().clamp_min(1e-12))


def _carry_anew(clothing: Clothing, bones: Tensor, swing: Tensor) -> Tensor:
    """Let those of the skeleton carry that move most like the clothes in F frames; returns the swing[F,K,6] that is left.

    A bag hangs from the pelvis however near the leg. Points around a bone's centre tell, OFF m from it.
    """
    moved = torch.stack([clothing.hang(one, by)[len(one) :] for one, by in zip(bones, swing)])  # [F,K,4,4]
    around = OFF * torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).to(moved)
    points = clothing.centres[:, None] + around
    wanted = torch.einsum("fkab,kpb->kfpa", moved[..., :3, :3], points) + moved.permute(1, 0, 2, 3)[:, :, None, :3, 3]
    pushed, hanging = clothing.pushed(bones)[..., None, None], clothing.upright(bones)[:, None, None]
    parts = torch.lerp(hanging, bones[:, None], pushed)  # [F,K,24,4,4]
    shifts = parts[..., :3, 3].permute(1, 0, 3, 2)[:, :, None]
    found = torch.einsum("fkjab,kpb->kfpaj", parts[..., :3, :3], points) + shifts
    count, pull = len(moved), (STAY * len(moved)) ** 0.5
    for k in range(len(clothing)):
        before = clothing.carriers[k]
        one = torch.ones_like(before)
        rows = [found[k].reshape(-1, found.shape[-1]), pull * one.diag(), FULL * count * one[None]]
        told = [wanted[k].reshape(-1), pull * before, FULL * count * one[:1]]
        share, _ = nnls(torch.cat(rows).double().cpu().numpy(), torch.cat(told).double().cpu().numpy())
        clothing.carriers[k] = torch.as_tensor(share / share.sum()).to(before)
    carried = clothing.carried(bones)
    left = torch.linalg.solve(carried, moved)
    turn, _, other = torch.linalg.svd(left[..., :3, :3])
    turn = turn @ other
    shift = (left[..., :3, :3] @ clothing.centres[..., None])[..., 0] + left[..., :3, 3] - clothing.centres
    return torch.cat([rotvec_from_matrix(turn), shift], -1) / clothing.units


def _ridge(told: Tensor, wanted: Tensor, ridge: float) -> Tensor:
    """Factors [K,6,R] that take told[F,R] to wanted[F,K,6], pulled to 0; each of R by its own size."""
    x, y = told.double(), wanted.flatten(1).double()
    size = x.square().mean(0).sqrt().clamp_min(1e-9)
    x = x / size
    eye = ridge * torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
    eye[0, 0] = 1e-6  # the first is 1: what clothes do on average is their shape
    found = torch.linalg.solve(x.mT @ x + eye, x.mT @ y) / size[:, None]
    return found.mT.unflatten(0, wanted.shape[1:]).to(told)


def _untold(told: Tensor, wanted: Tensor, ridge: float) -> float:
    """Mean squared error of PARTS of the clip, each told from the others."""
    part = torch.arange(len(told)) * PARTS // len(told)
    errors = []
    for i in range(PARTS):
        factors = _ridge(told[part != i], wanted[part != i], ridge)
        errors.append(((factors @ told[part == i].T).permute(2, 0, 1) - wanted[part == i]).square())
    return float(torch.cat(errors).mean())

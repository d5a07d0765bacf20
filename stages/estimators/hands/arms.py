"""Arms of a fitted body, turned so that its palms lie where the hands' points are: least squares over shoulders, elbows, wrists.

BlazePose knows a hand by its wrist and two knuckles alone, and the body fit hardly sees how a forearm is twisted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.joints import COLLARS, ELBOWS, SHOULDERS, WRISTS
from stages.avatar.body.rotations import matrix_from_rotvec, rotvec_from_matrix
from stages.avatar.body.smpl import Body, rest_relative_transforms
from stages.avatar.cameras.pinhole import project, rescale_viewmats
from stages.records import BodyModel, BodyPoses, Cameras

PLACE, FACING = 0.04, 0.25  # spread of a palm's points, of the hand's length, and of the way it faces, in rad
# rad by which shoulder, elbow and wrist turn further, about the bone (x in the T-pose) and across it
SPREAD = ((0.05, 0.05, 0.05), (0.6, 0.1, 0.1), (0.6, 0.8, 0.8))
RATE = 3.0  # rad/s at which that changes
STEPS, SETTLED = 80, 1e-3


@dataclass(frozen=True)
class SeenPalms:
    """Palms in F frames, left and right: five `points` [F,2,5,2] px, `turns` [F,2,3,3] from the rest pose to camera axes, in the
    frames `read` [F,2]; `length` [F,2] px of the hands. `rest` [2,5,3] m are the points on the body in the T-pose."""

    points: np.ndarray
    turns: np.ndarray
    read: np.ndarray
    length: np.ndarray
    rest: np.ndarray


def arms_to_palms(
    model: BodyModel, poses: BodyPoses, cameras: Cameras, times: np.ndarray, palms: SeenPalms
) -> BodyPoses:
    """The poses with arms that bring the palms to where they are seen, smoothly over `times` [F] s; elsewhere they stay."""
    body, chain = Body(model), (SHOULDERS, ELBOWS, WRISTS)
    rest = body.rest_joints(_tensor(poses.betas))
    turns = matrix_from_rotvec(_tensor(np.concatenate([poses.global_orient, poses.body_pose], 1)).unflatten(1, (-1, 3)))
    collars = rest_relative_transforms(rest, turns, body.parents)[:, list(COLLARS)]
    above, shoulders = collars[..., :3, :3], _moved(collars[..., :3, :3], rest[list(SHOULDERS)]) + collars[..., :3, 3]
    arms = torch.stack([turns[:, list(pair)] for pair in chain], 1)
    bones = [rest[list(end)] - rest[list(start)] for start, end in zip(chain, chain[1:])]
    views = rescale_viewmats(cameras.viewmats, poses.world_from_sfm)
    views[:, :3, 3] += (views[:, :3, :3] @ poses.transl[..., None])[..., 0]
    view, Ks, spread = _tensor(views), _tensor(cameras.Ks), torch.tensor(SPREAD)[:, None]
    points, facing, read, length = (_tensor(v) for v in (palms.points, palms.turns, palms.read, palms.length))
    palm = _tensor(palms.rest) - rest[list(WRISTS), None]
    gaps = _tensor(np.diff(times).clip(1e-3))[:, None, None, None]
    spreads = torch.zeros(len(poses), 3, 2, 3, requires_grad=True)  # that each turns further
    optimizer = torch.optim.LBFGS([spreads], max_iter=STEPS, tolerance_change=SETTLED, line_search_fn="strong_wolfe")

    def turned() -> Tensor:
        return arms @ matrix_from_rotvec(spread * spreads)

    def cost() -> Tensor:
        optimizer.zero_grad()
        upper, fore, hand = turned().unbind(1)
        upper = above @ upper
        fore = upper @ fore
        hand = fore @ hand
        wrists = shoulders + _moved(upper, bones[0]) + _moved(fore, bones[1])
        placed = wrists[:, :, None] + _moved(hand[:, :, None], palm)
        pixels, _ = project(placed.flatten(1, 2), view, Ks)
        off = ((pixels.unflatten(1, (2, 5)) - points) / (PLACE * length.clamp(min=1))[..., None, None]).square().sum(-1)
        aside = (view[:, None, :3, :3] @ hand - facing).square().sum((-1, -2)) / (2 * FACING**2)
        total = (read[..., None] * 2 * ((1 + off).sqrt() - 1)).sum() + (read * 2 * ((1 + aside).sqrt() - 1)).sum()
        total = total + spreads.square().sum() + ((spread * spreads).diff(dim=0) / gaps / RATE).square().sum()
        total.backward()
        return total

    optimizer.step(cost)
    with torch.no_grad():
        found = rotvec_from_matrix(turned()).numpy().astype(np.float64)
    body_pose = poses.body_pose.copy().reshape(len(poses), -1, 3)
    for s in np.flatnonzero(palms.read.any(0)):  # a hand that is never read moves no arm
        body_pose[:, [pair[s] - 1 for pair in chain]] = found[:, :, s]
    return replace(poses, body_pose=body_pose.reshape(len(poses), -1))


def _moved(turns: Tensor, vectors: Tensor) -> Tensor:
    return (turns @ vectors[..., None])[..., 0]


def _tensor(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)

"""Gives a finished avatar the fingers and the face of its body."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from stages import gestures, records
from stages.avatar.body.face import face_at
from stages.avatar.body.fingers import bent_skin, finger_joints
from stages.avatar.body.joints import HANDS, HEAD
from stages.avatar.body.skinning import knn_weights
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import load_avatar
from stages.avatar.splats.neighbours import mean_near, nearest

HELD = 0.02  # of a Gaussian's weights: less than that on a hand's joints is none of a finger's
NEAR = 6  # points of the face whose mean move a Gaussian follows
FACE = (0.015, 0.035)  # m from the face between which Gaussians move less and less: hair does not smile
STILL = 5e-4  # m: a Gaussian that no shape moves further is left out


@torch.no_grad()
def attach(
    avatar: records.Avatar, body: records.BodyModel, rig: gestures.HandsFace, hands: np.ndarray | None = None
) -> records.Avatar:
    """The avatar with fingers and face, learned on a `body` whose `rig` is of its size; no face where that has no points.

    `hands` [2,15,3] rad is the pose in which fingers were in the clip; None: that of the body at rest.
    """
    model, betas = Body(body), torch.as_tensor(avatar.betas).float()
    vertices, _ = model.rest(betas)
    shape = torch.zeros(2, 15, 3) if hands is None else torch.as_tensor(hands).float()
    resting = load_avatar(avatar).resting
    joints, tips = finger_joints(rig, vertices)
    rows, shares = HandSkin.of(rig, vertices, model.lbs_weights, shape).shares(resting.means, resting.weights)
    fingers = gestures.Fingers(*(part.numpy() for part in (joints, tips, shape, rows.int(), shares)))
    if not len(rig.face_points):
        return replace(avatar, fingers=fingers)
    face = _face(rig, face_at(rig, model.v_template, model.shapedirs, betas), resting.means, resting.weights)
    return replace(avatar, fingers=fingers, face=face)


class HandSkin(NamedTuple):
    """The skin of both hands of a body at rest, bent as in a clip: points [V,3] m, with weights [V,24+30] of limbs and fingers."""

    points: Tensor
    weights: Tensor

    @classmethod
    def of(cls, rig: gestures.HandsFace, vertices: Tensor, limbs: Tensor, shape: Tensor) -> HandSkin:
        """Of `vertices` [V,3] m at rest with weights `limbs` [V,24], fingers in the pose `shape` [2,15,3] rad."""
        skin, own = (limbs[:, list(HANDS)].sum(1) > 0).nonzero()[:, 0], torch.as_tensor(rig.finger_weights).to(limbs)
        return cls(bent_skin(rig, vertices, shape)[skin], torch.cat([limbs, own], 1)[skin])

    @torch.no_grad()
    def shares(self, means: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Rows [M] of Gaussians of the hands, at rest at means[N,3] m with weights[N,J], and what fingers take of these [M,30].

        Each shares its weight on a hand as the skin around it does.
        """
        rows = (weights[:, list(HANDS)].sum(1) > HELD).nonzero()[:, 0]
        near = knn_weights(means[rows], self.points, self.weights, NEAR)
        hand, found = near[:, list(HANDS)], near[:, records.JOINTS :].unflatten(1, (2, 15))
        there = weights[rows][:, list(HANDS)]
        shares = (found / hand.clamp_min(1e-6)[..., None] * there[..., None]).flatten(1)
        kept = shares.amax(1) > 0
        return rows[kept], shares[kept]


def _face(rig: gestures.HandsFace, points: Tensor, means: Tensor, weights: Tensor) -> gestures.Face:
    """Each Gaussian of the head moves as the points of the face around it, as far as the head's bone carries it."""
    away = nearest(points, means, 1)[0][:, 0].to(points)
    rows = ((away < FACE[1]) & (weights[:, HEAD] > 0)).nonzero()[:, 0]
    part = ((FACE[1] - away[rows]) / (FACE[1] - FACE[0])).clamp(0, 1)
    shapes = torch.as_tensor(rig.face_shapes).movedim(0, 1)
    moves = part[:, None] * mean_near(shapes, points, means[rows], NEAR).movedim(1, 0)
    kept = moves.norm(dim=2).amax(0) > STILL
    return gestures.Face(rows[kept].int().numpy(), moves[:, kept].half().numpy())

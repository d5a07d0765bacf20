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
from stages.avatar.drawing.avatar import Mien, load_avatar
from stages.avatar.splats.neighbours import nearest, shares_of

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
    mien = FaceSkin.of(rig, model, betas).at(resting.means, resting.weights)
    moves = mien.moves.unflatten(1, (-1, 3))
    kept = moves.norm(dim=2).amax(0) > STILL
    face = gestures.Face(mien.rows[kept].int().numpy(), moves[:, kept].half().numpy())
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


class FaceSkin(NamedTuple):
    """The face of a body at rest: points [P,3] m, and how each of K shapes moves them at coefficient 1, [K,P,3] m."""

    points: Tensor
    shapes: Tensor

    @classmethod
    def of(cls, rig: gestures.HandsFace, model: Body, betas: Tensor) -> FaceSkin:
        """Of a body of a `rig`, for `betas` [10]."""
        return cls(face_at(rig, model.v_template, model.shapedirs, betas), torch.as_tensor(rig.face_shapes))

    @torch.no_grad()
    def at(self, means: Tensor, weights: Tensor) -> Mien:
        """What of Gaussians at rest at means[N,3] m, with weights[N,J], moves with the face: as the points around each, as far as
        the head's bone carries it.
        """
        first, last = self.points.aminmax(dim=0)
        around = ((means > first - FACE[1]) & (means < last + FACE[1])).all(1)
        rows = (around & (weights[:, HEAD] > 0)).nonzero()[:, 0]
        away, near = nearest(self.points, means[rows], NEAR)
        close = away[:, 0] < FACE[1]
        rows, away, near = rows[close], away[close].to(self.points), near[close]
        part = ((FACE[1] - away[:, :1]) / (FACE[1] - FACE[0])).clamp(0, 1)
        moves = torch.einsum("mk,smkc->smc", part * shares_of(away), self.shapes[:, near])
        return Mien(rows, moves.flatten(1))

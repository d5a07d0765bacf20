"""A body that does what a `Plan` says: pelvis and feet where it has them, legs by the law of cosines."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.joints import ANKLES, ELBOWS, FEET, HEAD, HIPS, KNEES, NECK, SHOULDERS, SPINE
from stages.avatar.body.smpl import Body
from tests.made.family.motions import SIDES, Plan

HANG = 1.2
"""How far the arms of the T-pose are lowered to hang, rad."""
STRETCH = 0.998
"""Share of its length that a leg is straightened to at most."""
ROUNDS = 8
"""How often the pelvis is raised where something else than the soles is below the floor."""


def perform(plan: Plan, body: Body, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """global_orient [F,3], body_pose [F,69] rad, transl [F,3] m of a body (float64) that follows the plan.

    The lowest vertex is on y = 0, or as high over it as the plan flies.
    """
    shape = torch.from_numpy(betas)
    skin, rest = (part.numpy() for part in body.rest(shape))
    unit = -skin[:, 1].min()  # pelvis over the sole
    tall = plan.tall * unit
    for _ in range(ROUNDS):
        orient, pose, pelvis = _pose(plan, rest, unit, tall)
        transl = pelvis - rest[0]
        with torch.no_grad():
            vertices = body(shape, *(torch.from_numpy(part) for part in (orient, pose, transl)))[0].numpy()
        low = vertices[..., 1].min(1) - plan.flight * unit
        sunk = (-low - 0.01).clip(0)
        if not sunk.any():
            break  # all rounds after it would be this one
        tall = tall + sunk
    transl[:, 1] -= low
    return orient, pose, transl


def _pose(plan: Plan, rest: np.ndarray, unit: float, tall: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """orient [F,3], pose [F,69], pelvis [F,3]: the pelvis at most as high over the floor as both legs reach."""
    count = len(plan.times)
    local = np.tile(np.eye(3), (count, 24, 1, 1))
    root = _turn("yx", plan.yaw, plan.lean)
    local[:, 0] = root
    pelvis = np.stack([plan.spot[:, 0] * unit, tall + plan.flight * unit, plan.spot[:, 1] * unit], 1)
    ankles, feet = zip(*(_foot(plan, rest, unit, i) for i in range(2)))
    reach = np.linalg.norm(rest[KNEES[0]] - rest[HIPS[0]]), np.linalg.norm(rest[ANKLES[0]] - rest[KNEES[0]])
    for i in range(2):  # lower the pelvis onto a leg that is too short
        offset = root @ (rest[HIPS[i]] - rest[0])
        away = ankles[i] - (pelvis + offset)
        level = np.hypot(away[:, 0], away[:, 2]).clip(max=STRETCH * sum(reach))
        drop = -away[:, 1] - np.sqrt((STRETCH * sum(reach)) ** 2 - level**2)
        pelvis[:, 1] -= drop.clip(0)
    for i in range(2):
        hip = pelvis + root @ (rest[HIPS[i]] - rest[0])
        thigh, shin = _leg(hip, ankles[i], rest[[HIPS[i], KNEES[i], ANKLES[i]]], plan.yaw / 2 + plan.feet_yaw[:, i] / 2)
        local[:, HIPS[i]] = root.mT @ thigh
        local[:, KNEES[i]] = thigh.mT @ shin
        local[:, ANKLES[i]] = shin.mT @ feet[i]
        local[:, FEET[i]] = _turn("x", -plan.heels[:, i].clip(0))  # the toes stay flat
    for joint, share in zip(SPINE, (0.35, 0.35, 0.3)):
        local[:, joint] = _turn("x", share * plan.bend)
    local[:, NECK] = local[:, HEAD] = _turn("x", plan.nod / 2)
    for i, side in enumerate(SIDES):
        local[:, SHOULDERS[i]] = _turn("xz", -plan.ahead[:, i], side * (plan.up[:, i] - HANG))
        local[:, ELBOWS[i]] = _turn("y", -side * plan.elbows[:, i])
    turns = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(count, 72)
    return turns[:, :3].copy(), turns[:, 3:].copy(), pelvis


def _foot(plan: Plan, rest: np.ndarray, unit: float, i: int) -> tuple[np.ndarray, np.ndarray]:
    """The ankle [F,3] m and the foot's turn [F,3,3] where the ball of the foot is as planned."""
    turn = _turn("yx", plan.feet_yaw[:, i], plan.heels[:, i])
    ball = rest[FEET[i]] - rest[0]
    around = _turn("y", plan.feet_yaw[:, i]) @ (ball * [1, 0, 1])
    height = ball[1] + unit + plan.flight * unit
    place = plan.feet[:, i] * unit + around
    place[:, 1] += height
    return place + turn @ (rest[ANKLES[i]] - rest[FEET[i]]), turn


def _leg(hip: np.ndarray, ankle: np.ndarray, rest: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turns [F,3,3] of thigh and shin that take the ankle there, the knee ahead along `yaw`."""
    upper, lower = np.linalg.norm(np.diff(rest, axis=0), axis=1)
    along = ankle - hip
    length = np.linalg.norm(along, axis=1).clip(abs(upper - lower) * 1.01, (upper + lower) * STRETCH)
    down = along / np.linalg.norm(along, axis=1, keepdims=True)
    hinge = np.stack([np.cos(yaw), 0 * yaw, -np.sin(yaw)], 1)
    hinge = hinge - (hinge * down).sum(1, keepdims=True) * down
    hinge /= np.linalg.norm(hinge, axis=1, keepdims=True)
    first = (upper**2 + length**2 - lower**2) / (2 * length)
    out = np.sqrt((upper**2 - first**2).clip(0))
    knee = first[:, None] * down + out[:, None] * np.cross(down, hinge)
    own = np.diff(rest, axis=0)
    straight = np.array([1.0, 0, 0])
    turns = []
    for bone, goal in zip(own, (knee, length[:, None] * down - knee)):
        turns.append(_frame(goal, hinge) @ _frame(bone[None], straight[None]).mT)
    return turns[0], turns[1]


def _frame(bone: np.ndarray, hinge: np.ndarray) -> np.ndarray:
    """Axes [N,3,3] as columns: the hinge made square to the bone, against the bone, ahead."""
    up = -bone / np.linalg.norm(bone, axis=1, keepdims=True)
    left = hinge - (hinge * up).sum(1, keepdims=True) * up
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([left, up, np.cross(left, up)], -1)


def _turn(axes: str, *angles: np.ndarray) -> np.ndarray:
    """Turns [F,3,3] about body axes, the first written outermost."""
    return Rotation.from_euler(axes.upper(), np.stack(angles, 1)).as_matrix().reshape(-1, 3, 3)

"""Costs of the body fit: joints that bend as joints do, steady motion, an outline that lies on the mask's."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.records import JOINT_NAMES

SPREAD = {
    # standard deviation in rad about x, y, z of the joint's rotation vector; large means no opinion
    "hip": (0.9, 0.35, 0.35),
    "knee": (2.0, 0.08, 0.08),
    "ankle": (0.35, 0.2, 0.15),
    "foot": (0.1, 0.05, 0.05),
    "spine1": (0.25, 0.15, 0.12),
    "spine2": (0.15, 0.12, 0.1),
    "spine3": (0.15, 0.12, 0.1),
    "neck": (0.25, 0.3, 0.2),
    "head": (0.25, 0.3, 0.2),
    "collar": (0.1, 0.15, 0.2),
    "shoulder": (0.7, 1.2, 1.5),
    "elbow": (0.4, 2.0, 0.1),
    "wrist": (0.2, 0.25, 0.3),
    "hand": (0.05, 0.05, 0.05),
}
"""From the range of motion of standing people; hinges are tight across their axis."""
HINGES = (("left_knee", 0, 1.0), ("right_knee", 0, 1.0), ("left_elbow", 1, -1.0), ("right_elbow", 1, 1.0))
"""Joint, axis and sign of its bend, which goes from 0 to BEND_MOST."""
BEND_MOST, BEND_SLACK = 2.6, 0.06  # rad
CONTOUR_POINTS = 160
FIELD_SIDE = 256  # px of the longer side of the distance fields


def geman_mcclure(squared: Tensor, reach: float) -> Tensor:
    """Geman and McClure's robust cost (1987): like `squared` (in standard deviations) near zero, never above reach**2."""
    return squared / (1 + squared / reach**2)


def joint_spreads() -> Tensor:
    """SPREAD for the 23 joints [23,3]."""
    rows = [SPREAD.get(name) or SPREAD[name.partition("_")[2]] for name in JOINT_NAMES[1:]]
    return torch.tensor(rows)


def pose_prior(body_pose: Tensor, spread: Tensor) -> Tensor:
    """Cost [F] of local rotation vectors [F,23,3] rad: how far from rest, and hinges bent the wrong way."""
    cost = (body_pose / spread).square().sum((-1, -2))
    for name, axis, sign in HINGES:
        bend = sign * body_pose[:, JOINT_NAMES.index(name) - 1, axis]
        cost = cost + (torch.relu(-bend).square() + torch.relu(bend - BEND_MOST).square()) / BEND_SLACK**2
    return cost


def acceleration(x: Tensor, times: Tensor) -> Tensor:
    """Second time derivative [F-2,...] of `x` [F,...] at uneven `times` [F] s."""
    step = (times[1:] - times[:-1]).view(-1, *[1] * (x.dim() - 1))
    speed = (x[1:] - x[:-1]) / step
    return 2 * (speed[1:] - speed[:-1]) / (step[1:] + step[:-1])


@dataclass
class Outlines:
    """The masks' outlines: points, their outward directions, and how far every pixel is from the mask.

    `points` and `normals` [F,C,2] px, `weight` [F,C] (0 pads, and where the picture's border cuts the person),
    `field` [F,1,h,w] px outside the mask, over the whole picture of `size` (width, height) px; `known` [F] bool.
    """

    points: Tensor
    normals: Tensor
    weight: Tensor
    field: Tensor
    size: Tensor
    known: Tensor

    def outside(self, pixels: Tensor) -> Tensor:
        """Distance [F,M] px of `pixels` [F,M,2] from the mask; 0 inside it and outside the picture."""
        grid = pixels / self.size * 2 - 1
        inside = (grid.detach().abs() <= 1).all(-1)
        far = torch.nn.functional.grid_sample(self.field, grid[:, :, None].clamp(-1, 1), align_corners=False)[
            :, 0, :, 0
        ]
        return far * inside


def outlines(masks: list[np.ndarray]) -> Outlines:
    """Outlines of the masks [H,W] uint8 (255 = person), holes and specks below 2 % of the person left out."""
    rows, columns = masks[0].shape
    ratio = min(1.0, FIELD_SIDE / max(rows, columns))
    count = len(masks)
    points, normals = np.zeros((count, CONTOUR_POINTS, 2)), np.zeros((count, CONTOUR_POINTS, 2))
    weight = np.zeros((count, CONTOUR_POINTS))
    small = (max(1, round(columns * ratio)), max(1, round(rows * ratio)))
    field = np.zeros((count, 1, small[1], small[0]), np.float32)
    for i, mask in enumerate(masks):
        person = (mask > 127).astype(np.uint8)
        if not person.any():
            continue
        shrunk = (cv2.resize(mask, small, interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)
        if not shrunk.any():  # a speck: nothing to be outside of
            continue
        field[i, 0] = cv2.distanceTransform(1 - shrunk, cv2.DIST_L2, 5) / ratio
        pieces, _ = cv2.findContours(person, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        pieces = [p[:, 0].astype(np.float64) for p in pieces if cv2.contourArea(p) > 0.02 * person.sum()]
        if not pieces:
            continue
        smooth = [_smooth_contour(piece) for piece in pieces]
        line, outward = (np.concatenate(part) for part in zip(*smooth, strict=True))
        pick = np.linspace(0, len(line) - 1, CONTOUR_POINTS).round().astype(int)
        points[i], normals[i] = line[pick] + 0.5, outward[pick]
        inner = (points[i] > 4).all(1) & (points[i] < np.array([columns, rows]) - 4).all(1)
        weight[i] = inner
    known = torch.tensor(weight.sum(1) > CONTOUR_POINTS // 4)
    return Outlines(
        points=torch.tensor(points, dtype=torch.float32),
        normals=torch.tensor(normals, dtype=torch.float32),
        weight=torch.tensor(weight, dtype=torch.float32),
        field=torch.tensor(field, dtype=torch.float32),
        size=torch.tensor([columns, rows], dtype=torch.float32),
        known=known,
    )


def _smooth_contour(piece: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed contour [N,2] (cv2's order) smoothed over its pixel steps, and its outward unit normals [N,2]."""
    reach = max(1, min(4, len(piece) // 8))
    kernel = np.ones(2 * reach + 1) / (2 * reach + 1)
    wrapped = np.concatenate([piece[-reach:], piece, piece[:reach]])
    line = np.stack([np.convolve(column, kernel, "valid") for column in wrapped.T], -1)
    along = np.roll(line, -reach, 0) - np.roll(line, reach, 0)
    (x, y), (x_next, y_next) = (line - line.mean(0)).T, (np.roll(line, -1, 0) - line.mean(0)).T
    area = (x * y_next - y * x_next).sum()
    outward = np.stack([along[:, 1], -along[:, 0]], -1) * np.sign(area)
    return line, outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)


def sight_turns(pixels: Tensor, K: Tensor) -> Tensor:
    """Rotations [F,3,3] about the camera's y axis that take its z axis to the columns `pixels` [F,2] px; `K` [F,3,3]."""
    angle = torch.atan2(pixels[:, 0] - K[:, 0, 2], K[:, 0, 0])
    return matrix_from_rotvec(torch.stack([0 * angle, angle, 0 * angle], -1))

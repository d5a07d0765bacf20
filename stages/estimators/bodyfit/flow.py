"""How the person's surface moves from frame to frame, by optical flow: how parts turn in depth, which landmarks hardly tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from stages.estimators.bodyfit.terms import geman_mcclure

OFF, OFF_SHARE = 0.003, 0.1  # of the person's height, and of the way itself, that flow errs
SIDE, KEPT = 256, 128  # px of the crop in which flow is found, and of the field that is kept
MARGIN = 0.1  # of the person's extent, around it in the crop
LONGEST = 0.25  # s between two frames, beyond which flow is not looked for
EDGE = 3  # px of the crop from the mask's edge within which flow is that of both sides
AGREE, AGREE_SHARE = 1.0, 0.05  # px of the crop, and share of the flow, by which there and back may differ


@dataclass(frozen=True)
class SurfaceFlow:
    """Where the person's pixels of frame i lie in frame i + 1, for F frames in square crops around the person.

    `field` [F-1,3,S,S]: the way in px of the picture times how sure it is, and how sure, 0..1; `corner` [F-1,2] px and
    `side` [F-1] px of the crops.
    """

    field: Tensor
    corner: Tensor
    side: Tensor

    def at(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """The way [F-1,M,2] px and how sure it is [F-1,M] of `pixels` [F-1,M,2]; 0 outside the crops."""
        grid = (pixels - self.corner[:, None]) / self.side[:, None, None] * 2 - 1
        found = torch.nn.functional.grid_sample(self.field, grid[:, :, None], align_corners=False)[..., 0].mT
        sure = found[..., 2]
        return found[..., :2] / sure.clamp(min=1e-3)[..., None], sure


def flow_cost(flow: SurfaceFlow, pixels: Tensor, shown: Tensor, height: Tensor) -> Tensor:
    """Cost of surface points that move otherwise than the pictures do: the mean over frames of the sum over points.

    `pixels` [F,M,2] px of the same points of the body in all frames, `shown` [F,M] where nothing hides them; `height` [F] px
    of the person.
    """
    if len(pixels) < 2:
        return pixels.new_zeros(())
    moved, sure = flow.at(pixels[:-1].detach())
    weight = sure * shown[:-1] * shown[1:]
    spread = OFF * height[:-1, None] + OFF_SHARE * moved.norm(dim=-1)
    off = (pixels[1:] - pixels[:-1] - moved).square().sum(-1) / spread**2
    return (weight * geman_mcclure(off, 3.0)).sum() / len(pixels)


def surface_flow(images: Sequence[np.ndarray], masks: Sequence[np.ndarray], times: np.ndarray) -> SurfaceFlow:
    """Flow between neighbouring `images` uint8 [H,W,3] where `masks` uint8 [H,W] (255 = person) show the person in both."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    count = len(images) - 1
    field = np.zeros((count, 3, KEPT, KEPT), np.float32)
    corner, side = np.zeros((count, 2)), np.ones(count)
    here = cv2.cvtColor(images[0], cv2.COLOR_RGB2GRAY)
    for i in range(count):
        pictures = [here, cv2.cvtColor(images[i + 1], cv2.COLOR_RGB2GRAY)]
        here = pictures[1]
        both = [masks[i] > 127, masks[i + 1] > 127]
        if times[i + 1] - times[i] > LONGEST or not both[0].any() or not both[1].any():
            continue
        rows, columns = np.nonzero(both[0] | both[1])
        low, high = np.array([columns.min(), rows.min()]), np.array([columns.max() + 1, rows.max() + 1])
        side[i] = (1 + 2 * MARGIN) * (high - low).max()
        corner[i] = (low + high) / 2 - side[i] / 2
        field[i] = _between(search, pictures, both, corner[i], side[i])
    f32 = torch.float32
    return SurfaceFlow(torch.tensor(field), torch.tensor(corner, dtype=f32), torch.tensor(side, dtype=f32))


def _between(
    search: cv2.DISOpticalFlow, pictures: list[np.ndarray], masks: list[np.ndarray], corner: np.ndarray, side: float
) -> np.ndarray:
    """The field [3,S,S] of one crop."""
    ratio = SIDE / side
    into = np.array(
        [[ratio, 0, -ratio * corner[0] - 0.5 + 0.5 * ratio], [0, ratio, -ratio * corner[1] - 0.5 + 0.5 * ratio]]
    )
    how = cv2.INTER_AREA if ratio < 1 else cv2.INTER_LINEAR
    here, there = (cv2.warpAffine(p, into, (SIDE, SIDE), flags=how, borderMode=cv2.BORDER_REPLICATE) for p in pictures)
    inner = []
    for mask in masks:
        small = cv2.warpAffine(mask.astype(np.uint8), into, (SIDE, SIDE), flags=cv2.INTER_NEAREST)
        inner.append(cv2.erode(small, np.ones((2 * EDGE + 1,) * 2, np.uint8)).astype(np.float32))
    ahead, back = (search.calc(*pair, np.zeros((SIDE, SIDE, 2), np.float32)) for pair in ((here, there), (there, here)))
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    at = (x + ahead[..., 0], y + ahead[..., 1])
    returned = cv2.remap(back, *at, cv2.INTER_LINEAR)
    apart = np.linalg.norm(ahead + returned, axis=-1)
    size = np.linalg.norm(ahead, axis=-1)
    sure = inner[0] * cv2.remap(inner[1], *at, cv2.INTER_LINEAR) * (apart < AGREE + AGREE_SHARE * size)
    weighted = np.dstack([ahead * sure[..., None], sure]).astype(np.float32)
    small = cv2.resize(weighted, (KEPT, KEPT), interpolation=cv2.INTER_AREA)
    return (small / [ratio, ratio, 1]).transpose(2, 0, 1)

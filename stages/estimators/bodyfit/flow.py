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
PLACES = np.dstack(np.meshgrid(np.arange(SIDE), np.arange(SIDE))).astype(np.float32)  # columns and rows of the crop


@dataclass(frozen=True)
class Crop:
    """A square window around a person: its `corner` [2] px of the picture and `side` px, seen SIDE px large."""

    corner: np.ndarray
    side: float

    @classmethod
    def around(cls, person: np.ndarray, margin: float) -> Crop | None:
        """Around what is True in `person` [H,W], with a margin as a share of its longer side; None if nothing is."""
        rows, columns = np.nonzero(person)
        if len(rows) == 0:
            return None
        low, high = np.array([columns.min(), rows.min()]), np.array([columns.max() + 1, rows.max() + 1])
        side = float((1 + 2 * margin) * (high - low).max())
        return cls((low + high) / 2 - side / 2, side)

    def into(self, K: np.ndarray) -> np.ndarray:
        """The intrinsics [3,3] of the crop, of a picture with `K` [3,3] px."""
        zoom = SIDE / self.side
        shift = np.array([[zoom, 0, -zoom * self.corner[0]], [0, zoom, -zoom * self.corner[1]], [0, 0, 1]])
        return shift @ K

    def outside(self, pixels: np.ndarray) -> np.ndarray:
        """Where pixels [...,2] of the crop are in the picture, px."""
        return pixels * (self.side / SIDE) + self.corner

    def picture(self, image: np.ndarray) -> np.ndarray:
        """The crop [S,S] of an image [H,W] uint8; beyond its border the border goes on."""
        how = cv2.INTER_AREA if self.side > SIDE else cv2.INTER_LINEAR
        return cv2.warpAffine(image, self._warp(), (SIDE, SIDE), flags=how, borderMode=cv2.BORDER_REPLICATE)

    def inner(self, person: np.ndarray) -> np.ndarray:
        """bool [S,S]: the person of `person` bool [H,W], without the EDGE px along their outline."""
        small = cv2.warpAffine(person.astype(np.uint8), self._warp(), (SIDE, SIDE), flags=cv2.INTER_NEAREST)
        return cv2.erode(small, np.ones((2 * EDGE + 1,) * 2, np.uint8)) > 0

    def _warp(self) -> np.ndarray:
        """OpenCV's matrix from picture to crop; its pixel centres are at whole numbers."""
        zoom = SIDE / self.side
        return np.array([[zoom, 0, 0.0], [0, zoom, 0]]) + np.c_[np.zeros((2, 2)), zoom * (0.5 - self.corner) - 0.5]


@dataclass(frozen=True)
class SurfaceFlow:
    """Where the person's pixels of frames `first` [N] lie in frames `second` [N], in square crops around the person.

    `field` [N,3,S,S]: the way in px of the picture times how sure it is, and how sure, 0..1; `corner` [N,2] px and `side` [N] px
    of the crops; `share` of the way that it may be off by.
    """

    field: Tensor
    corner: Tensor
    side: Tensor
    first: Tensor
    second: Tensor
    share: float

    @classmethod
    def of(cls, found: Sequence[tuple[np.ndarray, Crop, int, int]], share: float) -> SurfaceFlow:
        """From pairs of frames: the field [3,S,S] as of `kept`, its crop, the first and the second frame."""
        f32 = torch.float32
        return cls(
            torch.tensor(np.array([field for field, *_ in found], np.float32).reshape(-1, 3, KEPT, KEPT)),
            torch.tensor(np.array([crop.corner for _, crop, *_ in found]).reshape(-1, 2), dtype=f32),
            torch.tensor([crop.side for _, crop, *_ in found], dtype=f32),
            torch.tensor([first for *_, first, _ in found], dtype=torch.long),
            torch.tensor([second for *_, second in found], dtype=torch.long),
            share,
        )

    def at(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """The way [N,M,2] px and how sure it is [N,M] of `pixels` [N,M,2]; 0 outside the crops."""
        grid = (pixels - self.corner[:, None]) / self.side[:, None, None] * 2 - 1
        found = torch.nn.functional.grid_sample(self.field, grid[:, :, None], align_corners=False)[..., 0].mT
        sure = found[..., 2]
        return found[..., :2] / sure.clamp(min=1e-3)[..., None], sure


def flow_cost(flow: SurfaceFlow, pixels: Tensor, shown: Tensor, height: Tensor) -> Tensor:
    """Cost of surface points that move otherwise than the pictures do: the sum over points and pairs, over the frames.

    `pixels` [F,M,2] px of the same points of the body in all frames, `shown` [F,M] where nothing hides them; `height` [F] px
    of the person.
    """
    if len(flow.first) == 0:
        return pixels.new_zeros(())
    here, there = pixels[flow.first], pixels[flow.second]
    moved, sure = flow.at(here.detach())
    weight = sure * shown[flow.first] * shown[flow.second]
    # norm() takes 70 times as long on numbers that lie so
    spread = OFF * height[flow.first, None] + flow.share * moved.square().sum(-1).sqrt()
    off = (there - here - moved).square().sum(-1) / spread**2
    return (weight * geman_mcclure(off, 3.0)).sum() / len(pixels)


def surface_flow(images: Sequence[np.ndarray], masks: Sequence[np.ndarray], times: np.ndarray) -> SurfaceFlow:
    """Flow between neighbouring `images` uint8 [H,W,3] where `masks` uint8 [H,W] (255 = person) show the person in both.

    `times` [F] s: frames more than LONGEST apart are no neighbours.
    """
    found = []
    there = cv2.cvtColor(images[0], cv2.COLOR_RGB2GRAY)
    for i in range(len(images) - 1):
        here, there = there, cv2.cvtColor(images[i + 1], cv2.COLOR_RGB2GRAY)
        both = [masks[i] > 127, masks[i + 1] > 127]
        crop = Crop.around(both[0] | both[1], MARGIN)
        if crop is not None and both[0].any() and both[1].any() and times[i + 1] - times[i] <= LONGEST:
            found.append((_between((here, there), both, crop), crop, i, i + 1))
    return SurfaceFlow.of(found, OFF_SHARE)


def _between(pictures: tuple[np.ndarray, np.ndarray], masks: list[np.ndarray], crop: Crop) -> np.ndarray:
    """The field [3,S,S] of one crop."""
    inner = [crop.inner(mask).astype(np.float32) for mask in masks]
    ahead, apart, to = there_and_back(*(crop.picture(picture) for picture in pictures))
    agree = apart < AGREE + AGREE_SHARE * length(ahead)
    sure = inner[0] * sample(inner[1], to) * agree
    return kept(ahead * (crop.side / SIDE), sure)


def kept(way: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """The field [3,KEPT,KEPT] of ways [S,S,2] px of the picture that are `sure` [S,S], 0..1."""
    weighted = np.dstack([way * sure[..., None], sure]).astype(np.float32)
    return cv2.resize(weighted, (KEPT, KEPT), interpolation=cv2.INTER_AREA).transpose(2, 0, 1)


def there_and_back(here: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flow [S,S,2] from one crop to another, how far from the start the flow back ends [S,S], and where it leads [S,S,2]."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # threads cannot share one
    ahead, back = (search.calc(*pair, np.zeros((SIDE, SIDE, 2), np.float32)) for pair in ((here, there), (there, here)))
    to = PLACES + ahead
    return ahead, length(ahead + sample(back, to)), to


def length(way: np.ndarray) -> np.ndarray:
    """Lengths [S,S] of ways [S,S,2] float32."""
    return cv2.magnitude(way[..., 0], way[..., 1])


def sample(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The picture [S,S,...] at places `at` [S,S,2] float32, whole numbers being pixel centres; 0 outside."""
    return cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)

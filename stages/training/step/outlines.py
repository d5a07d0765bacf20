"""Several people in one clip: whose each pixel is, and where somebody nearer hides whether one of them is there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from stages.training.step.losses import SEAM, dilated
from stages.training.views import FittedBody, Views, halved

CLOSE = 0.3  # m of depth between two hips: closer ones the fits cannot order
NEXT = 0.01  # of the longer side: somebody so near in the picture may hide part of a person
CLEAR = 8  # frames in which nobody hides a person, from which on finishing looks at no others


class Outline(NamedTuple):
    """One person among several: masks uint8[F,H,W] (255 = this one), and hidden uint8[F,H,W], 255 where nobody can tell.

    There somebody nearer stands before them, or the masks do not agree whose a pixel is.
    """

    masks: Tensor
    hidden: Tensor

    def half(self) -> Outline:
        """The same at half the resolution, by area."""
        return Outline(*(halved(part[..., None])[..., 0] for part in self))

    def clear(self, frames: list[int]) -> list[int]:
        """Those of `frames` in which nothing hides them, or all where these are fewer than CLEAR."""
        found = [i for i in frames if not self._touched(i)]
        return found if len(found) >= CLEAR else frames

    def _touched(self, frame: int) -> bool:
        return bool((dilated(self.hidden[frame] / 255, NEXT) * self.masks[frame] > 127).any())


def outlines(views: Views, masks: Sequence[Tensor], people: Sequence[FittedBody]) -> list[Outline]:
    """The outline of each person, from their masks uint8[F,H,W] and their bodies; those of `views` cover everybody.

    A person is hidden where somebody is who stands nearer to the camera, or not surely farther away.
    """
    depths = torch.stack([_depths(views, person) for person in people])
    everybody, found = torch.stack(list(masks)), []
    nobodys = 255 * ((everybody.amax(0) < 128) & (views.masks > 127)).to(torch.uint8)
    for k, own in enumerate(masks):
        before = depths < depths[k] + CLOSE
        before[k] = False
        others = torch.where(before[..., None, None], everybody, 0).amax(0)
        hidden = torch.stack([dilated(one / 255, SEAM) > 0 for one in torch.maximum(others, nobodys)])
        found.append(Outline(own, 255 * hidden.to(torch.uint8)))
    return found


def _depths(views: Views, person: FittedBody) -> Tensor:
    """How far before the camera the hips are [F] m; nearest of all where no fit tells."""
    hips = person.transl + person.joints[0]
    depth = (views.viewmats[:, 2, :3] * hips).sum(1) + views.viewmats[:, 2, 3]
    return torch.where(person.confidence > 0, depth, -torch.inf)

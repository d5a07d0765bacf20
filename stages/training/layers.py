"""What one training step draws: everything, the person alone, and the scene in front of the person."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.effects.motion_blur import BlurredRendering
from stages.avatar.rasterize import Layer, Rendering
from stages.avatar.splats.gaussians import Splats
from stages.training.settings import Params
from stages.training.views import NEAR, person_box

CELLS = 64  # along the longer side of a picture, in which the person's nearest depth is looked up


class DrawnFrame(NamedTuple):
    """A training frame, its exposure and what was drawn of it, by layer; None for a person or a scene that was not."""

    frame: int
    image: Tensor
    mask: Tensor
    gains: Tensor | None
    person: Splats | None
    scene: Splats | None
    layers: dict[str, Layer]
    drawn: dict[str, Rendering | BlurredRendering]

    def window(self, name: str) -> tuple[slice, slice]:
        """Rows and columns of the picture that a layer shows."""
        window = self.layers[name].window
        left, top, right, bottom = window or (0, 0, self.mask.shape[1], self.mask.shape[0])
        return slice(top, bottom), slice(left, right)

    def person_target(self) -> tuple[Tensor, Tensor, Tensor]:
        """Image, mask and background[3] of the layer of the person alone."""
        crop, background = self.window("person"), self.layers["person"].background
        return self.image[crop], self.mask[crop], self.mask.new_zeros(3) if background is None else background


@torch.no_grad()
def foreground_occluders(scene: Splats, person: Tensor, viewmat: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """Which Gaussians of the scene are nearer to a camera than the person's means[N,3] in the same cell of the picture.

    Nothing can be in front of a person who is seen. Person pixels teach the scene nothing, so a loss removes what is
    there. In cells without the person, a Gaussian counts if it is nearer than the whole person. One depth for the whole
    person would also remove the floor under their feet, and shadows fall into the hole.
    """
    size = max(width, height) / CELLS
    columns, rows = math.ceil(width / size), math.ceil(height / size)

    def seen(points: Tensor) -> tuple[Tensor, Tensor]:
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        on = local[:, :2] / local[:, 2:].clamp_min(NEAR) * K.diagonal()[:2] + K[:2, 2]
        column, row = (on / size).floor().nan_to_num(-1.0).unbind(1)  # what is not finite is in no cell
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows) & (local[:, 2] > NEAR)
        return local[:, 2], torch.where(inside, row * columns + column, rows * columns).long()

    (depth, cell), (theirs, home) = seen(scene.means), seen(person)
    nearest = theirs.new_full((rows * columns + 1,), torch.inf).scatter_reduce(0, home, theirs, "amin")
    nearest[-1] = torch.inf
    first = theirs[home < rows * columns]
    beside = first.amin() if len(first) else -torch.inf
    return depth < torch.where(nearest.isinf(), beside, nearest)[cell]


def layers_of(
    human: Splats | None,
    scene: Splats | None,
    mask: Tensor,
    viewmat: Tensor,
    K: Tensor,
    params: Params,
    generator: torch.Generator,
) -> dict[str, Layer]:
    """The pictures that a step's losses need, by name: `all`, `person`, and `occluders` where the scene learns.

    mask[H,W] 0..1 and K[3,3] px of the frame; the random backgrounds come from `generator`.
    """
    layers: dict[str, Layer] = {}
    if scene is not None:
        layers["all"] = Layer(background=torch.rand(3, generator=generator).to(K), stop=params.early_stop)
    if human is not None:
        n, total = len(human.means), len(human.means) + (0 if scene is None else len(scene.means))
        rows = torch.arange(total, device=K.device) < n
        height, width = mask.shape
        box = person_box(mask, human.means.detach(), viewmat, K)
        if params.human_loss:
            layers["person"] = Layer(rows, box, torch.rand(3, generator=generator).to(K), params.early_stop)
        if scene is not None and scene.means.requires_grad:
            before = torch.cat([~rows[:n], foreground_occluders(scene, human.means, viewmat, K, width, height)])
            layers["occluders"] = Layer(before, box, stop=params.early_stop)
    return layers

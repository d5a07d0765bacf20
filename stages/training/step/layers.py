"""What one training step draws: everything, each person alone, and the scene in front of each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.cameras.pinhole import onto
from stages.avatar.effects.motion_blur import BlurredRendering
from stages.avatar.rasterize import Layer, Rendering
from stages.avatar.splats.gaussians import Splats
from stages.training.settings import Params
from stages.training.step.person import PersonLearner
from stages.training.views import NEAR, person_box

CELLS = 64  # along the longer side of a picture, in which the person's nearest depth is looked up


class DrawnPerson(NamedTuple):
    """A person in a training frame: their `splats`, their mask[H,W] in 0..1, and known[H,W], 1 where the frame shows whose it is.

    `known` None: everywhere.
    """

    splats: Splats
    mask: Tensor
    known: Tensor | None = None


class DrawnFrame(NamedTuple):
    """A training frame, its exposure and what was drawn of it, by layer; the mask is that of all people.

    No `figures` where nobody was drawn, no `scene` where it was not.
    """

    frame: int
    image: Tensor
    mask: Tensor
    gains: Tensor | None
    people: Sequence[PersonLearner]
    figures: Sequence[DrawnPerson]
    scene: Splats | None
    layers: dict[str, Layer]
    drawn: dict[str, Rendering | BlurredRendering]

    def window(self, name: str) -> tuple[slice, slice]:
        """Rows and columns of the picture that a layer shows."""
        window = self.layers[name].window
        left, top, right, bottom = window or (0, 0, self.mask.shape[1], self.mask.shape[0])
        return slice(top, bottom), slice(left, right)

    def person_target(self, k: int) -> tuple[Tensor, Tensor, Tensor]:
        """Image, mask and background[3] of the layer of one of `people` alone."""
        name = alone(k)
        crop, background = self.window(name), self.layers[name].background
        mask = self.figures[k].mask[crop]
        return self.image[crop], mask, self.mask.new_zeros(3) if background is None else background


def alone(k: int) -> str:
    """The layer of the `k`-th person drawn, alone."""
    return f"person {k + 1}"


def occluders(k: int) -> str:
    """The layer of what is before the `k`-th person drawn."""
    return f"before {alone(k)}"


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
        column, row = (
            (onto(local, K, NEAR) / size).floor().nan_to_num(-1.0).unbind(1)
        )  # what is not finite is in no cell
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows) & (local[:, 2] > NEAR)
        return local[:, 2], torch.where(inside, row * columns + column, rows * columns).long()

    (depth, cell), (theirs, home) = seen(scene.means), seen(person)
    nearest = theirs.new_full((rows * columns + 1,), torch.inf).scatter_reduce(0, home, theirs, "amin")
    nearest[-1] = torch.inf
    first = theirs[home < rows * columns]
    beside = first.amin() if len(first) else -torch.inf
    return depth < torch.where(nearest.isinf(), beside, nearest)[cell]


def layers_of(
    figures: Sequence[DrawnPerson],
    scene: Splats | None,
    viewmat: Tensor,
    K: Tensor,
    params: Params,
    generator: torch.Generator,
) -> dict[str, Layer]:
    """The pictures that a step's losses need, by name: `all`, each person `alone`, and their `occluders` where the scene learns.

    K[3,3] px of the frame; the random backgrounds come from `generator`.
    """
    layers: dict[str, Layer] = {}
    if scene is not None:
        layers["all"] = Layer(background=torch.rand(3, generator=generator).to(K))
    counts = [len(figure.splats.means) for figure in figures]
    people, first = sum(counts), 0
    row = torch.arange(people + (0 if scene is None else len(scene.means)), device=K.device)
    for k, (figure, n) in enumerate(zip(figures, counts, strict=True)):
        means, (height, width) = figure.splats.means, figure.mask.shape
        box = person_box(figure.mask, means.detach(), viewmat, K)
        if params.human_loss:
            own = (first <= row) & (row < first + n)
            layers[alone(k)] = Layer(own, box, torch.rand(3, generator=generator).to(K))
        if scene is not None and scene.means.requires_grad:
            before = torch.cat([row[:people] < 0, foreground_occluders(scene, means, viewmat, K, width, height)])
            layers[occluders(k)] = Layer(before, box)
        first += n
    return layers

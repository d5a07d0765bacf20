"""What one training step draws: everything, the person alone, and what of the scene is before the person."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.gaussians import Splats
from stages.avatar.rasterize import Layer
from stages.avatar.schedule import Options
from stages.avatar.views import person_box


def veil(scene: Splats, person: Tensor, viewmat: Tensor) -> Tensor:
    """Which Gaussians of the scene are nearer to a camera than most of the person's means[N,3].

    Where the person is seen nothing can be there, and as person pixels teach the scene nothing, it must be told.
    """
    with torch.no_grad():
        depth = person @ viewmat[2, :3] + viewmat[2, 3]
        far = depth.kthvalue(max(1, int(0.9 * len(depth)))).values
        return scene.means @ viewmat[2, :3] + viewmat[2, 3] < far


def layers_of(
    human: Splats | None,
    scene: Splats | None,
    mask: Tensor,
    viewmat: Tensor,
    K: Tensor,
    options: Options,
    generator: torch.Generator,
) -> dict[str, Layer]:
    """The pictures that a step's losses need, by name: `all`, `person`, and `veil` where the scene learns.

    mask[H,W] 0..1 and K[3,3] px of the frame; the random backgrounds come from `generator`.
    """
    layers = {}
    if scene is not None:
        layers["all"] = Layer(background=torch.rand(3, generator=generator).to(K))
    if human is not None:
        n, total = len(human.means), len(human.means) + (0 if scene is None else len(scene.means))
        rows = torch.arange(total, device=K.device) < n
        box = person_box(mask, human.means.detach(), viewmat, K)
        if options.human_loss:
            layers["person"] = Layer(rows, box, torch.rand(3, generator=generator).to(K))
        if scene is not None and scene.means.requires_grad:
            layers["veil"] = Layer(torch.cat([~rows[:n], veil(scene, human.means, viewmat)]), box)
    return layers

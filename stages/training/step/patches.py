"""The perceptual term of a training: LPIPS on patches of the person.

It does not look at the whole picture: four more patches anywhere, at weight 1, cost 2.0 dB (`docs/lab/2026-11/accuracy.md`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.measures.lpips import Lpips
from stages.training.settings import Params
from stages.training.step import losses

SIDE = 128  # px


class PatchLoss:
    """The mean LPIPS of a few patches; without a `network` there is none."""

    def __init__(self, network: Lpips | None, params: Params, generator: torch.Generator):
        self.network, self.params, self.generator = network, params, generator

    def __call__(self, step: int, rendered: Tensor, image: Tensor, mask: Tensor, background: Tensor) -> Tensor | float:
        """The term for rendered and image [H,W,3] at a step, 0 where it is not due.

        Patches lie around pixels of the person, mask[H,W] in 0..1; the target is the person over `background`[3]. A patch
        that is too small for the network counts as 0.
        """
        network, params = self.network, self.params
        if network is None or step % params.perceptual_every:
            return 0.0
        target = losses.over_background(image, mask, background)
        patches = [losses.random_patch(mask, SIDE, self.generator) for _ in range(params.perceptual_patches)]
        if min(target[patches[0]].shape[:2]) < network.smallest:  # all are of one size
            return 0.0
        pairs = (torch.stack([picture[at] for at in patches]) for picture in (rendered, target))
        return params.perceptual_weight * network(*pairs).mean()

"""The naive rasterizer once more, through torch.compile: every projected Gaussian on every pixel, gradients by autograd.

Needs a C++ compiler when it runs. The torch reference itself does not compile: its gradient hooks are beyond torch 2.13.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from stages.avatar.rasterize.rendering import ALPHA_MAX, ALPHA_MIN, T_STOP
from tests.benchmarks.naive import Screen, Workload, covariances


def blend(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, order: Tensor, pixels: Tensor) -> Tensor:
    """Colours [P,3] at pixels [P,2] over black."""
    dx, dy = (pixels[:, None] - means2d[order]).unbind(-1)
    a, b, c = conics[order].unbind(-1)
    alpha = opacities[order] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha < ALPHA_MIN, 0, alpha.clamp(max=ALPHA_MAX))
    passed = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], 1)
    return torch.where(passed > T_STOP, alpha * before, 0) @ colors[order]


class NaiveCompiled:
    """The compiled blend on one workload whose Gaussians all lie before the camera."""

    def __init__(self, work: Workload, screen: Screen):
        torch._dynamo.reset()
        self.blend = torch.compile(blend, options={"cpp.threads": torch.get_num_threads()})
        self.leaves = [torch.from_numpy(part).clone().requires_grad_() for part in screen[:4]]
        ys, xs = torch.meshgrid(torch.arange(work.camera.height), torch.arange(work.camera.width), indexing="ij")
        pixels = torch.stack([xs, ys], -1).reshape(-1, 2) + 0.5
        self.more = covariances(work)[0].float().argsort(stable=True), pixels
        self.v_image = work.v_image

    def forward(self) -> np.ndarray:
        """The image [H,W,3]."""
        self.image = self.blend(*self.leaves, *self.more).reshape(self.v_image.shape)
        return self.image.detach().numpy()

    def backward(self) -> None:
        """Gradients of `forward`'s image."""
        for leaf in self.leaves:
            leaf.grad = None
        self.image.backward(self.v_image)

    def gradients(self) -> tuple[np.ndarray, np.ndarray]:
        """Of means2d [N,2] and colors [N,3]."""
        return self.leaves[0].grad.numpy(), self.leaves[3].grad.numpy()

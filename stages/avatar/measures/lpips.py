"""LPIPS, the learned perceptual distance, in plain torch (Zhang et al. 2018, arXiv 1801.03924; version 0.1 heads)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, max_pool2d, relu

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Mean and deviation of ImageNet colours on [-1, 1]; LPIPS's own constants."""
EPS = 1e-10
"""Added to the length of a feature vector before dividing by it; LPIPS's own constant."""


class Lpips(nn.Module):
    """LPIPS of two pictures, on AlexNet (the measure) or VGG16 (the usual loss); 0 for equal pictures.

    `arrays` are the weights, any float type: conv{i}_w [out,in,k,k] and conv{i}_b [out] for the i-th convolution of the
    backbone, counted from 0 (5 in AlexNet, 13 in VGG16), lin{i} [channels] >= 0 for the head of tap i (0 to 4). They
    become buffers, so nothing here is trained.
    """

    colours: Tensor

    def __init__(self, arrays: Mapping[str, np.ndarray], dtype: torch.dtype = torch.float32):
        super().__init__()
        convolutions = sum(key.startswith("conv") and key.endswith("_w") for key in arrays)
        if convolutions not in (5, 13):
            raise ValueError(f"LPIPS weights hold {convolutions} convolutions, not AlexNet's 5 or VGG16's 13")
        self.net = "alex" if convolutions == 5 else "vgg"
        self.smallest = {"alex": 64, "vgg": 32}[self.net]
        for key in arrays:
            self.register_buffer(key, torch.as_tensor(np.asarray(arrays[key])).to(dtype), persistent=False)
        colours = torch.tensor([SHIFT, SCALE], dtype=dtype)
        self.register_buffer("colours", colours, persistent=False)

    def forward(self, a: Tensor, b: Tensor, legacy: bool = False) -> Tensor:
        """Distance [] or [P] of pictures [H,W,3] or [P,H,W,3] with values in [0, 1]; differentiable in both.

        `legacy` leaves out the step from [0, 1] to the [-1, 1] that LPIPS was fitted on, as HUGS and others do: the
        numbers come out smaller, and compare with theirs alone.
        Raises ValueError for pictures under `smallest` px (64 for AlexNet, whose last tap would see next to nothing).
        """
        if a.shape != b.shape or a.shape[-1] != 3:
            shapes = f"{tuple(a.shape)} and {tuple(b.shape)}"
            raise ValueError(f"LPIPS compares pictures [..., H, W, 3] of one size, not {shapes}")
        if min(a.shape[-3:-1]) < self.smallest:
            height, width = a.shape[-3:-1]
            raise ValueError(f"LPIPS on {self.net} needs {self.smallest} px each way, the picture has {width}x{height}")
        pair = torch.cat([a.reshape(-1, *a.shape[-3:]), b.reshape(-1, *b.shape[-3:])])
        shift, scale = self.colours
        taps = self.taps((((pair if legacy else 2 * pair - 1) - shift) / scale).permute(0, 3, 1, 2))
        distance = pair.new_zeros(())
        for i, tap in enumerate(taps):
            one, two = _unit(tap).chunk(2)
            head = getattr(self, f"lin{i}")
            distance = distance + ((one - two).square() * head[:, None, None]).sum(1).mean((-2, -1))
        return distance.reshape(a.shape[:-3])

    def taps(self, x: Tensor) -> list[Tensor]:
        """The five feature maps that LPIPS compares, of normalised pictures [P,3,H,W]."""
        return self._alex(x) if self.net == "alex" else self._vgg(x)

    def _conv(self, i: int, x: Tensor, stride: int = 1, padding: int = 1) -> Tensor:
        return relu(conv2d(x, getattr(self, f"conv{i}_w"), getattr(self, f"conv{i}_b"), stride, padding))

    def _alex(self, x: Tensor) -> list[Tensor]:
        taps = [self._conv(0, x, stride=4, padding=2)]
        taps.append(self._conv(1, max_pool2d(taps[-1], 3, 2), padding=2))
        taps.append(self._conv(2, max_pool2d(taps[-1], 3, 2)))
        taps.append(self._conv(3, taps[-1]))
        taps.append(self._conv(4, taps[-1]))
        return taps

    def _vgg(self, x: Tensor) -> list[Tensor]:
        taps: list[Tensor] = []
        i = 0
        for depth in (2, 2, 3, 3, 3):
            x = max_pool2d(x, 2, 2) if taps else x
            for _ in range(depth):
                x, i = self._conv(i, x), i + 1
            taps.append(x)
        return taps


def _unit(features: Tensor) -> Tensor:
    """Features [P,C,H,W] divided by their length over C; where all are 0 they stay 0 (norm's gradient there is 0)."""
    return features / (features.norm(dim=1, keepdim=True) + EPS)

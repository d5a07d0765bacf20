"""The three networks of HUGS (appearance, geometry, deformation) as corrections of the initial Gaussians.

Each network ends in a zero-initialised layer and its output is added to the initial value, so that the first render
is exactly the initial body. The paper's pretraining, which teaches random networks those same values, is not needed.
"""

from __future__ import annotations

import llvmlite.binding
import torch
from torch import Tensor, nn

TEMPERATURE = 0.1  # of the skinning softmax (paper, appendix)
OWN = "opacity", "sh", "turn", "scale"  # corrections that each Gaussian has of its own, beside those of the networks
WIDTHS = {"appearance": (64, 64), "geometry": (128, 128), "deformation": (128, 128, 128)}  # released configuration

FAST = bool({"avx512bf16", "amx-bf16"} & {n for n, has in llvmlite.binding.get_host_cpu_features().items() if has})
"""Whether this processor multiplies bfloat16 matrices natively: hidden layers then take 0.4 times the time."""


def _network(width: int, hidden: tuple[int, ...], out: int, generator: torch.Generator) -> nn.Sequential:
    widths = (width, *hidden, out)
    linear = [nn.Linear(before, after) for before, after in zip(widths, widths[1:])]
    for layer in linear:
        bound = layer.in_features**-0.5
        nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
        nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    nn.init.zeros_(linear[-1].weight)
    nn.init.zeros_(linear[-1].bias)
    *inner, last = linear
    return nn.Sequential(*(part for layer in inner for part in (layer, nn.GELU())), last)


def _run(network: nn.Sequential, features: Tensor) -> Tensor:
    """Hidden layers in bfloat16 where that pays; the last one in full, so that corrections are not quantised."""
    fast = FAST and features.dtype == torch.float32 and features.device.type == "cpu"
    with torch.autocast("cpu", torch.bfloat16, enabled=fast):
        hidden = network[:-1](features)
    return network[-1](hidden.to(features.dtype))


class Decoders(nn.Module):
    """Features [N,F] -> corrections of opacity, colour, position, rotation, scale and, with `joints`, skinning weights."""

    def __init__(self, features: int, joints: int, generator: torch.Generator):
        super().__init__()
        self.appearance = _network(features, WIDTHS["appearance"], 1 + 3, generator)
        self.geometry = _network(features, WIDTHS["geometry"], 12, generator)
        self.deformation = _network(features, WIDTHS["deformation"], joints, generator) if joints else None

    def forward(self, features: Tensor) -> dict[str, Tensor]:
        """Corrections: opacity [N] logit, sh [N,1,3], offset [N,3] m, turn [N,6], scale [N,3] log, skin [N,J]."""
        look = _run(self.appearance, features)
        shape = _run(self.geometry, features)
        skin = {"skin": _run(self.deformation, features)} if self.deformation else {}
        return {
            "opacity": look[:, 0],
            "sh": look[:, None, 1:],
            "offset": shape[:, 0:3],
            "turn": shape[:, 3:9],
            "scale": shape[:, 9:12],
        } | skin


class Residuals(nn.Module):
    """Corrections as parameters: one row a Gaussian, 0 at first; all of them if `alone`, without networks.

    Beside networks they add detail finer than a triplane's cells; `HumanModel.xyz` and the networks then correct
    places and skinning weights.
    """

    def __init__(self, rows: int, joints: int, alone: bool):
        super().__init__()
        shapes = {"opacity": (), "sh": (1, 3), "turn": (6,), "scale": (3,)}
        if alone:
            shapes |= {"offset": (3,)} | ({"skin": (joints,)} if joints else {})
        for name, shape in shapes.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(rows, *shape)))

    def forward(self) -> dict[str, Tensor]:
        """As `Decoders.forward`."""
        return dict(self.named_parameters())

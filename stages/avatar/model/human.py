"""The trainable person: Gaussians in the canonical pose, decoded from a triplane (HUGS, section 3)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from stages.avatar.body.rotations import matrix_from_6d
from stages.avatar.kernels.products import products
from stages.avatar.model.decoders import OWN, TEMPERATURE, Decoders, Residuals
from stages.avatar.model.person import Canonical, Surfels
from stages.avatar.model.triplane import Triplane

MARGIN = 0.2  # of the body's size, on each side of the box of the triplane
START_OPACITY = 0.8  # an opaque body from the first step leaves the scene nothing to explain behind it
WEIGHT_FLOOR = 1e-4  # keeps skinning logits within 0.92 of each other, so that a joint at 0 can come back (E02)
OFFSET = 0.05  # metres; a usual thickness of clothes
COLOR = 0.1  # weight of Gaussians' own colours in the second penalty: what frames hardly show keeps the shared ones
SCALE_RANGE = 4.0  # a scale leaves its initial value by at most a factor e^4


class Shared(NamedTuple):
    """What the networks say of N Gaussians at the canonical pose: means[N,3] m, weights[N,J] and, as `Decoders.forward`, opacity,
    sh, turn and scale, to which corrections of each Gaussian's own are added.
    """

    means: Tensor
    weights: Tensor
    opacity: Tensor
    sh: Tensor
    turn: Tensor
    scale: Tensor


class HumanModel(nn.Module):
    """The trainable person: positions per Gaussian; all else = initial value + networks' output + residual of the Gaussian.

    They begin on the `skin` at the canonical pose, and on the `cloth` off it, if any. Two of the paper's ablations:
    without `lbs_learning` the skinning weights stay as they began; without `triplane` there are no networks.
    """

    rotations: Tensor
    log_sizes: Tensor
    logits: Tensor
    sh_starts: Tensor
    skin_logits: Tensor
    homes: Tensor
    ROWS = (
        "rotations",
        "log_sizes",
        "logits",
        "sh_starts",
        "skin_logits",
        "homes",
    )  # buffers, a row a Gaussian, as `xyz`

    def __init__(
        self,
        skin: Surfels,
        cloth: Surfels | None = None,
        *,
        channels: int,
        resolution: int,
        generator: torch.Generator,
        lbs_learning: bool = True,
        triplane: bool = True,
    ):
        super().__init__()
        start = skin if cloth is None else Surfels(*(torch.cat(pair) for pair in zip(skin, cloth, strict=True)))
        points, rotations, sizes, skinning = start
        joints = skinning.shape[1] if lbs_learning else 0
        self.triplane: Triplane | None = None
        self.decoders: Decoders | None = None
        if triplane:
            low, high = points.amin(0), points.amax(0)
            pad = MARGIN * torch.maximum(high - low, (high - low).max() * 0.25)
            self.triplane = Triplane(low - pad, high + pad, channels, resolution, generator)
            self.decoders = Decoders(self.triplane.width, joints, generator).to(points)
        self.residuals = Residuals(len(points), joints, alone=not triplane).to(points)
        self.xyz = nn.Parameter(points.clone())
        self.register_buffer("rotations", rotations)
        self.register_buffer("log_sizes", sizes.log())
        opaque = torch.full_like(points[:, 0], math.log(START_OPACITY / (1 - START_OPACITY)))
        self.register_buffer("logits", opaque)
        self.register_buffer("sh_starts", torch.zeros_like(points))
        self.register_buffer("skin_logits", TEMPERATURE * (skinning + WEIGHT_FLOOR).log())
        self.register_buffer("homes", points.clone())  # where each Gaussian began, see `initial`

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def normals(self) -> Tensor:
        """Unit normals [N,3] of skin and cloth where each Gaussian began, which those have that come of it."""
        return self.rotations[:, :, 2]

    def rows(self) -> list[tuple[nn.Module, str]]:
        """The parameters with one row a Gaussian: the module that owns each, and its name there."""
        return [(self, "xyz"), *((self.residuals, name) for name in self.residuals())]

    def forward(self) -> tuple[Canonical, Tensor, Tensor]:
        """Decode all Gaussians: the canonical person, and two penalties.

        The first is the mean squared distance by which points left the triplane's box, the second the mean squared
        correction of scale (log), opacity (logit) and place (in units of OFFSET), and COLOR times that of colours of their own.
        """
        shared, outside_box, moved = self.shared()
        rotations, scales, opacities, sh, changed = self.look(*shared[2:])
        person = Canonical(shared.means, rotations, scales, opacities, sh, shared.weights, self.normals)
        return person, outside_box, moved + changed

    def shared(self) -> tuple[Shared, Tensor, Tensor]:
        """What the networks say of all Gaussians, and the two penalties of `forward`, the second of places alone."""
        if self.triplane and self.decoders:
            out, outside_box = self.decoders(self.triplane(self.xyz)), self.triplane.outside(self.xyz)
        else:
            own = self.residuals()
            out, outside_box = own | {name: torch.zeros_like(own[name]) for name in OWN}, self.xyz.new_zeros(())
        skin_logits = self.skin_logits + out["skin"] if "skin" in out else self.skin_logits
        weights, moved = torch.softmax(skin_logits / TEMPERATURE, 1), (out["offset"] / OFFSET).square().sum(1).mean()
        return Shared(self.xyz + out["offset"], weights, *(out[name] for name in OWN)), outside_box, moved

    def look(
        self, opacity: Tensor, sh: Tensor, turn: Tensor, scale: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Rotations, scales, opacities and sh as in `Canonical`, of what is `Shared` of them and what is each Gaussian's own.

        Last the second penalty of `forward`, without places.
        """
        own, identity = self.residuals(), torch.tensor([1.0, 0, 0, 0, 1, 0]).to(self.xyz)
        opacity, sh, turn, scale = (a + own[name] for a, name in zip((opacity, sh, turn, scale), OWN, strict=True))
        ratio = scale / SCALE_RANGE
        scale = scale / torch.hypot(torch.ones_like(ratio), ratio)  # unlike tanh never flat
        return (
            products(self.rotations, matrix_from_6d(identity + turn)),
            (self.log_sizes + scale).exp(),
            torch.sigmoid(self.logits + opacity),
            self.sh_starts[:, None] + sh,
            (scale.square().sum(1) + opacity.square() + COLOR * own["sh"].square().sum((1, 2))).mean(),
        )

    def initial(self) -> Canonical:
        """The canonical person before training: the right answer where no frame has shown them.

        There the networks' features are still random, and Adam turns gradients near 0 into full steps.
        """
        weights = torch.softmax(self.skin_logits / TEMPERATURE, 1)
        opacities = torch.sigmoid(self.logits)
        parts = self.homes, self.rotations, self.log_sizes.exp(), opacities, self.sh_starts[:, None], weights
        return Canonical(*parts, self.normals)

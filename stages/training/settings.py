"""The settings of a training."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stages import contract


class Params(contract.Params):
    steps: int = Field(1400, gt=0)
    """Training frames looked at. Time grows linearly."""
    seconds: float = contract.internal(0, ge=0)
    """Time to spend, on this machine: `steps` and the sizes are then chosen by timing a few steps; 0 = not limited."""
    reserve: float = contract.internal(0, ge=0)
    """Of `seconds`, the time of so many steps is left over, for what comes after training."""
    reserve_least: float = contract.internal(0, ge=0)
    """The least of `reserve`, used when time is short and later stages do less."""
    half_until: float = Field(0.4, ge=0, le=1)
    """Share of the steps, from the first on, that use pictures of half the size."""
    frames_used: int = Field(0, ge=0)
    """Most training frames to learn from, spread evenly; 0 = all."""
    human_points: int = Field(27_500, gt=0)
    """Approximate number of Gaussians with which the person's skin begins, evenly spaced; 110,210 in the paper."""
    human_cap: int = Field(40_000, gt=0)
    """Most Gaussians the person may have in training, unless it begins with more; an opaque lining is put under the skin."""
    scene_cap: int = Field(140_000, gt=0)
    """Most Gaussians the scene may have, unless it begins with more: its budget of memory, 0.2 KB each with gradients and
    moments, 0.9 KB with colours of the 3rd degree."""
    scene_fill: int = Field(20_000, ge=0)
    """Points added to those of SfM before training, where SfM saw no texture."""
    scene_sh: int = Field(3, ge=0, le=3)
    """Degree of the scene's view-dependent colour if survey finds that the clip needs it; else it is 0."""
    channels: int = Field(32, gt=0, le=1024)
    """Features of each triplane cell."""
    resolution: int = Field(128, gt=1, le=4096)
    """Cells along each side of a triplane."""
    views_per_decode: int = Field(8, gt=0)
    """Training frames drawn for each run of the person's networks, whose gradients they share."""
    networks_until: float = Field(0.65, ge=0, le=1)
    """Share of the steps after which the person's networks rest; each Gaussian's own corrections go on."""
    perceptual_every: int = Field(0, ge=0)
    """A perceptual (LPIPS) term on the person every so many steps; 0 = never. Slow without a GPU."""
    perceptual_weight: float = Field(0.2, ge=0)
    """Weight of that term; 1 in the paper, which costs 0.3 / 0.4 dB more here."""
    perceptual_patches: int = Field(1, ge=1)
    """Patches of 128 px that this term compares, each around a random pixel of the person; 4 in the paper."""
    perceptual_net: Literal["alex", "vgg"] = "alex"
    """The network of that term: AlexNet, or VGG16 as in the paper, which takes seven times as long."""
    curve_points: int = Field(8, gt=0)
    """How often held-out accuracy is measured for the curve; the clock of the training stops meanwhile."""
    effect_gains: bool = True
    """Measure, after training, what each effect gains and costs."""
    lbs_learning: bool = True
    """Skinning weights are learned; else each Gaussian keeps those of the body point where it began (see `hugs ablate`)."""
    human_densify: bool = True
    """Gaussians of the person are added and removed."""
    human_loss: bool = True
    """The person is also drawn and compared alone; else the loss compares whole pictures only."""
    triplane: bool = True
    """Gaussians share corrections from a triplane and networks; else each has only its own, as in plain splatting."""
    joint: bool = True
    """Person and scene are trained together; else the first half of the steps trains the scene, the second the person."""

"""Another way to grow a scene, to measure ours against: 3D Gaussian Splatting as Markov Chain Monte Carlo.

Kheradmand et al. 2024, https://arxiv.org/abs/2404.09591. Faint Gaussians move to bright ones, new ones are copies of
bright ones, and positions walk at random. Constants are the paper's. Opacities and scales are pulled as ours are.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from stages.avatar.rasterize import gaussian_axes
from stages.training.step.densify import Plan, _regrow
from stages.training.step.fit import Fit

NOISE = 5e5  # times the rate of positions
STEEP, FAINT = 100.0, 0.995  # who walks: 1 / (1 + exp(-STEEP (1 - opacity - FAINT)))
MORE = 0.05  # share of Gaussians added in a round
COPIES = 51  # of one Gaussian, at most

learn = Fit._apply


def shared(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacities [N] and scales [N,3] with which copies[N] at one place draw about what one did (equation 9)."""
    each = 1 - (1 - opacities) ** (1 / copies)
    total = torch.zeros_like(each)
    for i in range(1, int(copies.max()) + 1):
        terms = [math.comb(i - 1, k) * (-1) ** k * each ** (k + 1) / math.sqrt(k + 1) for k in range(i)]
        total += torch.where(copies >= i, torch.stack(terms).sum(0), 0)
    return each, (opacities / total)[:, None] * scales


@torch.no_grad()
def relocate(scene, optimizer, growth, rules, rounds_left, generator) -> Plan:
    """In place of `densify.grow_scene`: same caps, same rounds."""
    opacities, count = scene.logit_opacities.sigmoid().double(), len(scene)
    dead = (opacities <= rules.min_opacity).nonzero()[:, 0]
    added = max(0, min(rules.cap - count, round(MORE * count)))
    chances = torch.where(opacities > rules.min_opacity, opacities, 0)
    chosen = torch.multinomial(chances, len(dead) + added, replacement=True, generator=generator)
    copies = (torch.bincount(chosen, minlength=count) + 1).clamp(max=COPIES)
    each, scales = shared(opacities, scene.log_scales.exp().double(), copies)
    scene.logit_opacities.copy_(each.clamp(rules.min_opacity, 1 - 1e-6).logit())
    scene.log_scales.copy_(scales.log())
    source = torch.cat([torch.arange(count), chosen[len(dead) :]])
    source[dead] = chosen[: len(dead)]
    fresh = torch.zeros(len(source), dtype=torch.bool)
    fresh[dead], fresh[count:] = True, True
    rows = Plan(source, fresh, torch.zeros_like(fresh), added, 0, len(dead))
    for name in scene.ROWS:
        setattr(scene, name, _regrow(optimizer, getattr(scene, name), rows))
    growth.start(len(scene), scene.means.device)
    return rows


@torch.no_grad()
def walking(fit: Fit, name: str) -> None:
    """In place of `Fit._apply`: faint Gaussians of the scene take a random step along their axes, too."""
    learn(fit, name)
    if name == "scene":
        scene, groups = fit.scene, fit.adam["scene"].param_groups
        lr = next(group["lr"] for group in groups if group["name"] == "means")
        axes = gaussian_axes(scene.quats, scene.log_scales.exp())
        walks = torch.sigmoid(STEEP * (1 - scene.logit_opacities.sigmoid() - FAINT))
        noise = torch.randn(len(scene), 3, 1, generator=fit.generator) * (lr * NOISE * walks)[:, None, None]
        scene.means += (axes @ (axes.mT @ noise))[..., 0]

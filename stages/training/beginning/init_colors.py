"""First colours of the person, read off the frames through the fitted body."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.cameras.pinhole import onto
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import rest
from stages.avatar.splats.neighbours import nearest
from stages.training.views import NEAR, FittedBody, Views

FACING = 0.3  # cosine between normal and view from which a Gaussian counts as seen; no occlusion is tested
LEAST = 2.0  # summed cosines of a Gaussian that has been seen enough


@torch.no_grad()
def seen_colors(human: HumanModel, person: FittedBody, views: Views, frames: list[int]) -> tuple[Tensor, Tensor]:
    """Mean colours [N,3] in 0..1 of an untrained person over `frames`, and how well each Gaussian was seen [N], 0..1.

    A Gaussian is seen where its normal faces the camera and its centre falls on the person's mask, weighted by the
    cosine. The others take the colour of the nearest seen one in the canonical pose; 0.5 if none is seen at all.
    """
    canonical, *_ = human()
    resting = person.gloved(rest(canonical, person.canonical_bones()))
    total, weight = torch.zeros_like(canonical.means), torch.zeros_like(canonical.means[:, 0])
    height, width = views.masks.shape[1:]
    for f in frames:
        splats = person.posed(resting, f)
        viewmat, K = views.viewmats[f], views.Ks[f]
        local = splats.means @ viewmat[:3, :3].T + viewmat[:3, 3]
        normal = torch.nn.functional.normalize(splats.axes[:, :, 2] @ viewmat[:3, :3].T, dim=1)
        cosine = -(normal * torch.nn.functional.normalize(local, dim=1)).sum(1)
        column, row = onto(local, K, NEAR).floor().long().T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
        seen = inside & (local[:, 2] > NEAR) & (cosine > FACING) & (views.masks[f][row, column] > 250)
        share = torch.where(seen, cosine, 0)
        total += share[:, None] * views.images[f][row, column].float() / 255
        weight += share
    known = weight >= min(LEAST, weight.max().item())
    if weight.max() == 0:
        return torch.full_like(total, 0.5), weight
    colors = total / weight.clamp_min(1e-6)[:, None]
    _, near = nearest(canonical.means[known], canonical.means[~known], 1)
    colors[~known] = colors[known][near[:, 0]]
    return colors, (weight / LEAST).clamp(max=1)

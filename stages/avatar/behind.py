"""What of a scene the person always hides: it takes the colours of what is seen around, and keeps them."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.bake import EDGE
from stages.avatar.compose import painted
from stages.avatar.losses import widened
from stages.avatar.neighbours import evenly, median_near
from stages.avatar.scene import SceneModel
from stages.avatar.views import LOOKS, Views

HIDDEN = 4.0  # times as many pixels behind the person as beside; with 1 a phone clip loses 0.5 dB, with 4 it loses 0.1
SURE = 0.3  # of the mean of pixels painted: neighbours that are asked for a colour paint this many
NEIGHBOURS = 24  # that are asked


def fill_behind(scene: SceneModel, views: Views, frames: list[int]) -> Tensor:
    """Give Gaussians that `frames` of `views` only show behind the person the colours around; returns them, bool[N].

    Only a fringe about the person has taught them, and Adam takes steps as large for a fringe: unchecked they turn into
    a bright ghost. A colour is the median of the nearest that are seen well; places and sizes stay.
    """
    splats = scene.splats().detach()
    counts = torch.zeros_like(splats.means)
    for i in evenly(frames, LOOKS):
        person = widened(views.masks[i].float() / 255, EDGE)
        kinds = torch.stack([1 - person, person, torch.zeros_like(person)], -1)
        counts += painted(splats, views.viewmats[i], views.Ks[i], kinds)
    beside, behind, _ = counts.unbind(1)
    hidden = behind > HIDDEN * beside
    sure = (beside > SURE * (beside + behind).mean()) & (behind < beside)
    if not (hidden.any() and sure.any()):
        return torch.zeros_like(hidden)
    with torch.no_grad():
        for colors in scene.colors():
            colors[hidden] = median_near(colors[sure], scene.means[sure], scene.means[hidden], NEIGHBOURS)
    return hidden

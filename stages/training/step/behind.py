"""The last colours of the scene where the person always hides or shades it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from stages.avatar.model.scene import SceneModel
from stages.avatar.splats.compose import painted_pixels
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import median_near, spread_evenly
from stages.training.seen import EDGE
from stages.training.step.losses import dilated
from stages.training.views import LOOKS, Views

HIDDEN = 16.0  # times as many pixels behind the person as beside; the phone clip: 1 loses 0.5 dB, 4 0.1, 16 0.03
ALWAYS = 0.7  # mean depth of the person's shadow over all frames: from there on a place is never seen lit
LIT = 0.3  # of it: neighbours that are asked for a colour are in less
SURE = 0.3  # of the mean of pixels painted: neighbours that are asked for a colour paint this many
NEIGHBOURS = 24  # that are asked


def inpaint_occluded(
    scene: SceneModel, views: Views, frames: list[int], shadow_depth: Callable[[int], Tensor]
) -> Tensor:
    """Give Gaussians that `frames` of `views` always hide or shade the colours around; returns which, bool[N].

    Behind the person only a fringe around them has gradients. Adam steps as far for a fringe as for all: they leave a
    bright ghost. In the person's shadow (`shadow_depth(frame)` [N] 0..1), no picture tells a dark surface from a dark
    shadow. A colour becomes the median of the nearest that are seen well; places and sizes stay.
    """
    splats = scene.splats().detach()
    beside, behind, shaded = torch.zeros(3, len(scene)).to(splats.means)
    for i in spread_evenly(frames, LOOKS):
        free, covered = beside_and_behind(splats, views, i)
        beside, behind, shaded = beside + free, behind + covered, shaded + free * shadow_depth(i)
    hidden = (behind > HIDDEN * beside) | (shaded > ALWAYS * beside)
    sure = (beside > SURE * (beside + behind).mean()) & (behind < beside) & (shaded < LIT * beside)
    if not (hidden.any() and sure.any()):
        return torch.zeros_like(hidden)
    with torch.no_grad():
        for colors in scene.colors():
            colors[hidden] = median_near(colors[sure], scene.means[sure], scene.means[hidden], NEIGHBOURS)[0]
    return hidden


def beside_and_behind(splats: Splats, views: Views, frame: int) -> tuple[Tensor, Tensor]:
    """How many pixels each Gaussian paints beside the person of a frame, and behind them: both [N]. No gradient."""
    person = dilated(views.masks[frame].float() / 255, EDGE)
    kinds = torch.stack([1 - person, person, torch.zeros_like(person)], -1)
    beside, behind, _ = painted_pixels(splats, views.viewmats[frame], views.Ks[frame], kinds).unbind(1)
    return beside, behind

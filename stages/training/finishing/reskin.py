"""Gives Gaussians that learned to move with other bones than the body does the body's skinning back."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.skinning import skin
from stages.avatar.model.person import Canonical, rest
from stages.training.views import FittedBody, Views, person_frames

OTHER = 0.5  # sum of |differences| of weights; kitchen clip: 2 % of the Gaussians, and specks in a new pose with them


@torch.no_grad()
def reskin(
    person: Canonical, usual: Tensor, body: FittedBody, views: Views, frames: list[int]
) -> tuple[Canonical, int]:
    """Replace skinning weights that are far from the `usual` ones [N,J], the body's, by those; also how many.

    In a new pose such Gaussians would fly off, and without them there would be holes: they go to where their new
    weights bring them closest to where the old ones did, the median over `frames` of `views`.
    """
    other = (person.weights - usual).abs().sum(1) > OTHER
    mine, weights = Canonical(*(part[other] for part in person)), usual[other]
    shown = person_frames(body, views, frames)
    resting, means = rest(mine, body.canonical_bones()), person.means.clone()
    if shown and other.any():
        places = []
        for bones in map(body.bones, shown):
            posed = mine._replace(means=skin(resting.means, mine.weights, bones)[0], weights=weights)
            places.append(rest(posed, bones).means)
        means[other] = skin(torch.stack(places).median(0).values, weights, body.canonical_bones())[0]
    return person._replace(means=means, weights=torch.where(other[:, None], usual, person.weights)), int(other.sum())

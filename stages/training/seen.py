"""What frames show of a person's Gaussians, for a step and for finishing."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.model.person import Canonical
from stages.avatar.splats.neighbours import nearest

OFF_BODY = 0.1  # metres from the body; hair and clothes seldom reach beyond
SEEN = 1e-3  # of the mean sum of colour gradients, under which no frame has shown a Gaussian
EDGE = 0.006  # of the longer side: the width inside an outline where colours are not the person's alone


def far_from_surface(means: Tensor, surface: Tensor) -> Tensor:
    """Which of the canonical means[N,3] are farther than OFF_BODY from all points of the `surface`[S,3] of skin and cloth."""
    distance, _ = nearest(surface, means, 1)
    return distance[:, 0] > OFF_BODY


def as_body_where_unseen(decoded: Canonical, initial: Canonical, color_grad_sum: Tensor) -> Canonical:
    """The `decoded` person, but with the `initial` values in rows that no training frame has shown.

    There the networks' features are still random.
    """
    never = unseen(color_grad_sum)
    pairs = zip(initial, decoded, strict=True)
    return Canonical(*(torch.where(never.view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in pairs))


def unseen(color_grad_sum: Tensor) -> Tensor:
    """Which rows [N] no training frame has shown, by the sums [N] >= 0 of the gradients of their colours."""
    return color_grad_sum <= SEEN * color_grad_sum.mean()

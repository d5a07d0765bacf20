"""Where clothes stand wide of the body: the outline of a skirt says nothing of the legs in it, and pulled them to its hem."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.body.smpl import Body
from stages.records import JOINT_NAMES

WIDE = (0.02, 0.035)
"""Shares of the person's height off the skin, between which an outline is believed less and less. Bare limbs have 0.006 at
most when landmarks alone have placed them, the thighs and knees in the skirt of the synthetic clip for setting 0.03 to 0.06."""
NEAR = 0.1  # m at rest around a place and around its mirror image: a leg that is off to one side is so on both legs
LEAST = 30  # contour points around a place; of fewer nothing is said


def snugness(places: Tensor, at: Tensor, gaps: Tensor) -> Tensor:
    """How far [M] outlines tell where the body is at `places` [M,3] m of the body at rest: 1 where clothes are snug, else to 0.

    Contour points of the whole clip, which belong `at` [N,3] m, are `gaps` [N] off the skin, shares of the person's height,
    positive outside. A limb in a wrong pose has the outline outside it on one side and inside on the other; a skirt has it
    outside on all: so the median tells.
    """
    folded, mirrored = (torch.cat([part[:, :1].abs(), part[:, 1:]], 1) for part in (places, at))
    found = torch.ones(len(places))
    for row, around in enumerate(torch.cdist(folded, mirrored) < NEAR):
        if around.sum() >= LEAST:
            found[row] = (WIDE[1] - gaps[around].median()) / (WIDE[1] - WIDE[0])
    return found.clamp(0, 1)


def hidden_joints(body: Body, places: Tensor, snug: Tensor) -> list[str]:
    """Names of the joints that wide clothes hide, by how `snug` [M] they are at `places` [M,3] m of the `body` at rest."""
    near = torch.cdist(body.joint_template, places) < NEAR
    return [name for name, around in zip(JOINT_NAMES, near) if around.any() and snug[around].mean() < 0.5]

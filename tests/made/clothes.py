"""Clothes by chance, on an avatar and on the ellipsoid of the tiny trainings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from stages.avatar.body.joints import ANKLES, FEET
from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.effects.clothing import Clothing, bones_for
from stages.avatar.model.person import Surfels
from stages.records import JOINTS, Avatar, Clothes
from stages.training.views import FittedBody

WIDE = 0.2  # m: how far a bone reaches
MOSTLY = 0.7  # of the weight


def some_clothes(count: int = 5, seed: int = 5) -> Clothes:
    """Bones down the body that swing by some 10 cm, each its own way, with the shoulders and one knee."""
    rng = np.random.default_rng(seed)
    axes = np.zeros((69, 2))
    axes[[47, 50], 0], axes[9, 1] = [1.2, -0.8], 1.0
    return Clothes(
        swings=rng.normal(0, 0.5, (count, 6, 3)),
        centres=np.stack([rng.normal(0, 0.15, count), np.linspace(-1.0, 0.5, count), np.zeros(count)], 1),
        carriers=rng.dirichlet(np.full(JOINTS, 0.2), count),
        mean=np.full(69, 0.02),
        axes=axes,
        low=np.full(2, -0.7),
        high=np.full(2, 0.6),
    )


def dress(avatar: Avatar, clothes: Clothes, bare: tuple[int, ...] = ()) -> Avatar:
    """The avatar with most of each Gaussian's weight on bones of the clothes near it; feet and joints `bare` wear none."""
    away = np.linalg.norm(avatar.means[:, None] - clothes.centres, axis=2)
    bells = np.exp(-0.5 * ((away - away.min(1, keepdims=True)) / WIDE) ** 2)
    own = MOSTLY * bells / bells.sum(1, keepdims=True)
    own[np.isin(avatar.lbs_weights.argmax(1), [*ANKLES, *FEET, *bare])] = 0
    skin = avatar.lbs_weights * (1 - own.sum(1, keepdims=True))
    return replace(avatar, lbs_weights=np.concatenate([skin, own], 1), clothes=clothes)


def dressed(person: FittedBody, frames: list[int]) -> FittedBody:
    """The ellipsoid with some cloth a third larger than itself."""
    chosen = slice(0, None, 6)
    points, weights = 1.3 * person.vertices[chosen], person.weights[chosen]
    hung, spread = bones_for(points, torch.full_like(points[:, 0], 0.08), weights)
    normals = torch.nn.functional.normalize(points, dim=1)
    cloth = Surfels(points, rotation_z_to(normals), torch.full_like(points, 0.02), spread)
    padded = torch.cat([person.weights, person.weights.new_zeros(len(person.weights), len(hung.centres))], 1)
    clothing = Clothing.start(hung, person.joints, person.body_pose[frames])
    return person._replace(weights=padded, clothing=clothing, cloth=cloth)

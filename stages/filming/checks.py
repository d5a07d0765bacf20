"""What is looked for before a film is drawn: people in each other, and people under the floor."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch

from stages.avatar.effects.shadow import Casters
from stages.filming.cast import Actor
from stages.records import Ground

EVERY = 0.2  # s between the pictures that are looked at
SURFACE = 3.0  # squared standard deviations of a limb's skin at which its ellipsoid ends: a hollow one has a third of radius^2
TOUCH, SUNK = 0.04, 0.05  # m that ellipsoids may be in each other or in the floor: they are not quite limbs
GONE = 1e-9  # m^2: a part that is not there


def faults_of(cast: Sequence[Actor], ground: Ground, count: int, fps: float) -> list[str]:
    """Sentences about people who are in each other or under the floor in `count` pictures: how far, and when."""
    looked_at = list(range(0, count, max(1, round(EVERY * fps))))
    bodies = [[_body(actor.casters(picture)) for picture in looked_at] for actor in cast]
    found = []
    for (one, a), (other, b) in combinations(enumerate(bodies), 2):
        deep = np.array([overlap(*pair) for pair in zip(a, b, strict=True)])
        if deep.max() > TOUCH:
            when, where = looked_at[int(deep.argmax())] / fps, 100 * deep.max()
            found.append(f"{cast[one].name} and {cast[other].name} are in each other by {where:.0f} cm at {when:.1f} s")
    for actor, posed in zip(cast, bodies, strict=True):
        low = np.array([lowest(middles, spreads, ground) for middles, spreads in posed])
        if low.min() < -SUNK:
            when, where = looked_at[int(low.argmin())] / fps, -100 * low.min()
            found.append(f"{actor.name} is under the floor by {where:.0f} cm at {when:.1f} s")
    return found


def overlap(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float:
    """How deep two bodies are in each other, m; less than 0: apart. Each is middles [P,3] and covariances [P,3,3] of limbs."""
    (a, spread_a), (b, spread_b) = one, other
    between = b[None] - a[:, None]
    away = np.linalg.norm(between, axis=-1)
    way = between / np.maximum(away, 1e-9)[..., None]
    reach = [
        np.sqrt(SURFACE * np.einsum("abi,abij,abj->ab", way, spread, way))
        for spread in (spread_a[:, None], spread_b[None])
    ]
    return float((reach[0] + reach[1] - away).max())


def lowest(middles: np.ndarray, spreads: np.ndarray, ground: Ground) -> float:
    """Height over the floor of a body's lowest limb, m."""
    reach = np.sqrt(SURFACE * np.einsum("i,pij,j->p", ground.up, spreads, ground.up))
    return float(((middles - ground.point) @ ground.up - reach).min())


def _body(parts: Casters) -> tuple[np.ndarray, np.ndarray]:
    middles, spreads = (torch.as_tensor(part).double().cpu().numpy() for part in parts)
    there = np.trace(spreads, axis1=1, axis2=2) > GONE
    return middles[there], spreads[there]

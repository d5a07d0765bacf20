"""How a garment of the synthetic clip moves: particles held together by rods, pulled to their shape, pushed off the body.

Positions instead of forces, after Müller et al. 2007, "Position based dynamics". In a fixed order, so the same motion
gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.kernels import njit
from stages.avatar.model.person import bone_transforms

STEP = 1 / 300
"""Seconds of a step."""
ROUNDS = 8
"""How often a step goes over all rods."""
GRAVITY = np.array([0.0, -9.81, 0.0])
DRAG = 1.5
"""Share of its speed that a particle loses in a second."""
MARGIN = 0.012
"""How far cloth stays off the skin, m."""
REACH = 0.12
"""How deep under the skin cloth is still pushed out, m."""
EVERY = 3
"""Of the body's vertices, those that push."""
WARM = 1.0
"""Seconds in which cloth comes to rest before the first frame."""
COMING, STAYING = 1.0, 1.5
"""Seconds in which somebody takes a pose out of the rest pose, and then stays in it, before cloth counts as settled."""


@dataclass(frozen=True)
class Particles:
    """G particles at rest `places` [G,3] m, which the skeleton carries with `weights` [G,24] to where they would like to be.

    `pinned` [G] are there always; the others are pulled there with `stiffness` [G] in 1/s^2. `rods` [R,2] keep their length.
    """

    places: np.ndarray
    weights: np.ndarray
    pinned: np.ndarray
    stiffness: np.ndarray
    rods: np.ndarray


Poses = tuple[np.ndarray, np.ndarray, np.ndarray]
"""global_orient [F,3], body_pose [F,69] rad, transl [F,3] m."""


def worn(
    cloths: Sequence[Particles], body: Body, faces: np.ndarray, betas: np.ndarray, poses: Poses, fps: float
) -> list[np.ndarray]:
    """Where the particles of each garment [F,G,3] m are while somebody moves through `poses`, `fps` a second."""
    orient, pose, transl = (torch.as_tensor(part, dtype=torch.float64) for part in poses)
    shape = torch.as_tensor(betas, dtype=torch.float64)
    skin, joints = body(shape, orient, pose, transl)[0].numpy(), body.rest(shape)[1]
    bones = torch.stack([bone_transforms(joints, body.parents, *one) for one in zip(orient, pose)])
    bones[:, :, :3, 3] += transl[:, None]
    return [simulate(cloth, bones.numpy(), skin, faces, fps) for cloth in cloths]


def settled(
    cloths: Sequence[Particles], body: Body, faces: np.ndarray, betas: np.ndarray, poses: Poses
) -> list[np.ndarray]:
    """As `worn`, but each pose is taken out of the rest pose and held until the garments have come to rest."""
    fps, each = 8.0, []
    share = (np.arange(round((COMING + STAYING) * fps) + 1) / fps / COMING).clip(max=1)
    share = (share**2 * (3 - 2 * share))[:, None]
    for orient, pose, transl in zip(*poses):
        count = (len(share), 1)
        moving = np.tile(orient, count), share * pose, np.tile(transl, count)
        each.append([places[-1] for places in worn(cloths, body, faces, betas, moving, fps)])
    return [np.stack(places) for places in zip(*each)]


def simulate(cloth: Particles, bones: np.ndarray, skin: np.ndarray, faces: np.ndarray, fps: float) -> np.ndarray:
    """Where the particles are at each frame [F,G,3] m, F > 1.

    `bones` [F,24,4,4] carry the rest pose to the frames in the world, `skin` [F,V,3] m is the body there with `faces`.
    """
    blend = np.einsum("gj,fjab->fgab", cloth.weights, bones[:, :, :3])
    wanted = np.einsum("fgab,gb->fga", blend[..., :3], cloth.places) + blend[..., 3]
    outwards = [vertex_normals(torch.from_numpy(one), torch.from_numpy(faces)).numpy()[::EVERY] for one in skin]
    times = np.arange(len(bones)) / fps
    goals, pushers = CubicSpline(times, wanted), CubicSpline(times, np.stack([skin[:, ::EVERY], np.stack(outwards)], 1))
    lengths = np.linalg.norm(np.subtract(*np.moveaxis(cloth.places[cloth.rods], 1, 0)), axis=1)
    free, now, found = ~cloth.pinned, wanted[0].copy(), []
    before, tick = now.copy(), round(-WARM / STEP)
    for time in times:
        while tick * STEP < time + STEP / 2:
            moment = max(tick * STEP, 0.0)
            goal = goals(moment)
            speed = (now - before) * (1 - DRAG * STEP)
            pull = cloth.stiffness[:, None] * (goal - now)
            before, now = now, now + speed + STEP**2 * (GRAVITY + pull)
            now[cloth.pinned] = goal[cloth.pinned]
            _hold(now, cloth.rods, lengths, free.astype(np.float64), ROUNDS)
            near, normals = pushers(moment)
            _push_off(now, near, normals, free)
            tick += 1
        found.append(now.copy())
    return np.stack(found)


@njit(cache=True)
def _hold(points: np.ndarray, rods: np.ndarray, lengths: np.ndarray, free: np.ndarray, rounds: int) -> None:
    """Move both ends of each rod to where it has its length again; pinned ends stay."""
    for _ in range(rounds):
        for r in range(len(rods)):
            a, b = rods[r]
            mobile = free[a] + free[b]
            if mobile == 0:
                continue
            x, y, z = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if length == 0:
                continue
            share = (length - lengths[r]) / (length * mobile)
            for k, d in enumerate((x, y, z)):
                points[a, k] += free[a] * share * d
                points[b, k] -= free[b] * share * d


def _push_off(points: np.ndarray, skin: np.ndarray, normals: np.ndarray, free: np.ndarray) -> None:
    """Move `free` points that are under the `skin` [S,3], or nearer to it than MARGIN, out along its `normals` [S,3]."""
    away, near = cKDTree(skin).query(points[free])
    out = ((points[free] - skin[near]) * normals[near]).sum(1)
    under = np.where((out < MARGIN) & (away < REACH), MARGIN - out, 0.0)
    points[free] += under[:, None] * normals[near]

"""A mesh as `surface_of` gives one, in no time: the body's own, with a small texture; and an avatar that has a surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from stages.avatar.body.skinning import WORDS, heaviest
from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.drawing.attach import attach
from stages.avatar.splats.gaussians import Splats
from stages.avatar.surface import mesh
from stages.avatar.surface.fuse import fused
from stages.avatar.surface.looks import all_around
from stages.formats.hands_face import read_hands_face
from stages.gestures import FACE_NAMES
from stages.records import Avatar, BodyModel, Mesh
from tests.made.tiny import make_avatar

EYE = np.array([0.031, 0.664, 0.143])
"""m: the left eye of the free body."""
FEW = [(0, 6, 0), (50, 3, 0.5), (-50, 3, 0)]
"""Rings of few cameras."""


def body_mesh(model: BodyModel, side: int = 8) -> Mesh:
    """The body of no betas; its texture is red above and blue below, and laid on from before it."""
    vertices, _ = Body(model).rest(torch.zeros(10))
    normals = vertex_normals(vertices, torch.as_tensor(np.asarray(model.faces)).long()).numpy()
    bones, weights, _ = heaviest(np.asarray(model.lbs_weights, np.float64), 4, WORDS)
    places = vertices.numpy()
    uvs = (places[:, :2] - places[:, :2].min(0)) / np.ptp(places[:, :2], axis=0) * [1, -1] + [0, 1]
    texture = np.zeros((side, side, 3), np.uint8)
    texture[: side // 2, :, 0] = texture[side // 2 :, :, 2] = 200
    return Mesh(places, normals, np.asarray(model.faces, np.int32), uvs.astype(np.float32), texture, bones, weights)


def handed_mesh(model: BodyModel) -> tuple[Mesh, np.ndarray]:
    """The free body's mesh on finger bones, with the jaw's shape, of 40 vertices, and the eyes', of 9; all its weights [V,54]."""
    rig = read_hands_face(model)
    assert rig is not None
    weights = np.concatenate([model.lbs_weights, rig.finger_weights], 1).astype(float)
    weights[:, 22:24] -= rig.finger_weights.reshape(-1, 2, 15).sum(2)
    bones, words, _ = heaviest(weights.clip(0), 4, WORDS)
    morphs = np.zeros((52, len(weights), 3), np.float32)
    morphs[FACE_NAMES.index("jawOpen"), :40] = [0, -0.03, 0.01]
    mesh = body_mesh(model)
    for side, across in (("Left", 1), ("Right", -1)):
        eye = np.linalg.norm(mesh.vertices - EYE * [across, 1, 1], axis=1).argsort()[:9]
        for way, move in (
            ("Up", [0, 3, 0]),
            ("Down", [0, -3, 0]),
            ("In", [-4 * across, 0, 0]),
            ("Out", [4 * across, 0, 0]),
        ):
            morphs[FACE_NAMES.index(f"eyeLook{way}{side}"), eye] = np.array(move) * 1e-3
    return replace(mesh, bones=bones, weights=words, morphs=morphs), weights


def handed_avatar(model: BodyModel) -> Avatar:
    """A thin tiny avatar with fingers and a face."""
    rig = read_hands_face(model)
    assert rig is not None
    return attach(make_avatar(model, every=20), model, rig)


def solid_avatar(model: BodyModel, count: int = 7000) -> Avatar:
    """The tiny avatar with as many Gaussians, evenly on the skin, flat and near enough to hide what is behind."""
    plain = make_avatar(model, every=1)
    skin = trimesh.Trimesh(plain.means, model.faces, process=False)
    points, rows = trimesh.sample.sample_surface(skin, count, seed=0)
    _, near = cKDTree(plain.means).query(points)
    names = ("opacities", "sh0", "shN", "lbs_weights")
    turns = trimesh.geometry.align_vectors
    quats = [trimesh.transformations.quaternion_from_matrix(turns([0, 0, 1], skin.face_normals[row])) for row in rows]
    return replace(
        plain,
        **{name: getattr(plain, name)[near] for name in names},
        means=points,
        quats=np.array(quats),
        scales=np.tile([0.017, 0.017, 0.003], (count, 1)),
    )


def balls(*centres: Sequence[float], radius: float = 0.15, count: int = 1500) -> Splats:
    """Flat opaque Gaussians on spheres around places in m."""
    rows = np.arange(count) + 0.5
    tilt, turn = np.arccos(1 - 2 * rows / count), np.pi * (1 + 5**0.5) * rows
    normals = np.stack([np.cos(turn) * np.sin(tilt), np.cos(tilt), np.sin(turn) * np.sin(tilt)], 1)
    means = np.concatenate([np.asarray(centre) + radius * normals for centre in centres])
    across = np.cross(normals, [0.3, 0.9, 0.1])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([0.01 * across, 0.01 * np.cross(normals, across), 0.001 * normals], 2)
    n = len(means)
    parts = (means, np.tile(axes, (len(centres), 1, 1)), np.full(n, 0.95), np.zeros((n, 1, 3)))
    return Splats(*(torch.as_tensor(part).float() for part in parts))


def edges(faces: np.ndarray) -> np.ndarray:
    """How often each edge is there."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(pairs, axis=0, return_counts=True)[1]


@contextmanager
def coarse() -> Iterator[None]:
    """Meshes are fused more coarsely than usual, from fewer pictures: it is quicker."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh, "LOOK", 256)
        patch.setattr(mesh, "fused", partial(fused, cell=0.01))
        patch.setattr(mesh, "all_around", partial(all_around, rings=[(0, 6, 0), (70, 2, 0), (-70, 2, 0)]))
        yield

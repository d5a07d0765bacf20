"""The avatar as a textured triangle mesh on its bones, for programs that draw no Gaussians."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from fast_simplification import simplify
from torch import Tensor

from stages import records
from stages.avatar.body.skinning import WORDS, all_bones, heaviest
from stages.avatar.body.smpl import vertex_normals
from stages.avatar.drawing.avatar import Baked, Mien, fingers_of, gloved, load_avatar, posed_by
from stages.avatar.model.person import bone_transforms, taken_back
from stages.avatar.surface.around import SOLID, around
from stages.avatar.surface.fuse import SEEN, Shell, fused
from stages.avatar.surface.looks import all_around
from stages.avatar.surface.texture import baked, unwrapped

FAR = 0.5  # m from every joint: what is farther off is no part of a person, and would make the grid large
SPECK = 0.002  # m^2: the area of the smallest piece that is kept
LOOK = 512  # px: pictures that give shape
CLOSE_LOOK = (256, 1536)  # px, at least and at most: pictures that give colours, three quarters of the texture


class NoSurfaceError(ValueError):
    """The Gaussians form no surface."""


@torch.no_grad()
def surface_of(avatar: records.Avatar, triangles: int = 20_000, texture: int = 2048) -> records.Mesh:
    """The surface of an avatar's Gaussians in the T-pose, with about so many `triangles`, its texture `texture` px square.

    It is fused in the canonical pose, legs apart, and taken back with each vertex's own four bones. NoSurfaceError where
    nothing solid is left of it.
    """
    person = load_avatar(avatar)
    bones = _canonical_bones(person, avatar.canonical_pose)
    if person.gloves is not None:
        bones = torch.cat([bones, fingers_of(person, person.gloves.shape, bones)], -3)
        person = gloved(person)
    whole = posed_by(person, bones, torch.zeros(3))
    near = _near(whole.means, person.joints, bones)
    splats = whole.rows(near)
    if not (splats.opacities > SOLID).any():
        raise NoSurfaceError(f"none of {len(avatar)} Gaussians is more opaque than {SOLID}")
    seen = splats.means[splats.opacities > SEEN].numpy()  # pictures hold all of them: what is beside a picture is air
    shell, dropped = _whole(fused(splats, all_around(seen, LOOK)))
    if len(shell.faces) == 0:
        raise NoSurfaceError(f"{len(avatar)} Gaussians form no surface larger than {SPECK * 1e4:.0f} cm^2")
    shell = _fewer(shell, triangles)
    faces = torch.as_tensor(shell.faces)
    ways = vertex_normals(torch.as_tensor(shell.vertices), faces).numpy()
    charts = unwrapped(*shell, texture)
    cut = charts.rows
    close = all_around(seen, _close_look(texture))
    colours = baked(charts, shell.vertices[cut], ways[cut], splats, close, texture)
    rows, share = (part.numpy() for part in around(splats, torch.as_tensor(shell.vertices)))
    which, words = _skin(share, person.resting.weights[near].double().numpy()[rows])
    weights = torch.as_tensor(all_bones(which, words, len(bones))).float()
    morphs = None if person.face is None else _morphs(person.face, near, rows, share)[:, cut]
    vertices, _ = taken_back(torch.as_tensor(shell.vertices).float(), weights, bones)
    normals = vertex_normals(vertices, faces)
    normals[~normals.any(1), 1] = 1  # a sliver has none, and files want unit normals
    left_out = {
        f"specks, each under {SPECK * 1e4:.0f} cm^2,": dropped,
        f"Gaussians over {FAR} m from every joint": int((~near).sum()),
    }
    return records.Mesh(
        vertices=vertices.numpy()[cut],
        normals=normals.numpy()[cut],
        faces=charts.faces.astype(np.int32),
        uvs=charts.uvs.astype(np.float32),
        texture=colours,
        bones=which[cut],
        weights=words[cut],
        said=tuple(f"{count} {what} left out" for what, count in left_out.items() if count),
        morphs=morphs,
    )


def _close_look(texture: int) -> int:
    """The side in px of pictures that give colours to a texture of a side."""
    return int(np.clip(3 * texture // 4, *CLOSE_LOOK))


def _canonical_bones(person: Baked, pose: np.ndarray) -> Tensor:
    """All bones [J,4,4] from the T-pose to the pose [69] in which the Gaussians were learned; clothes do not swing there."""
    bones = bone_transforms(person.joints, person.parents, torch.zeros(3), torch.as_tensor(np.asarray(pose)).float())
    return bones if person.clothing is None else person.clothing.hang(bones)


def _near(means: Tensor, joints: Tensor, bones: Tensor) -> Tensor:
    """Which of means [N,3] m are near one of the `joints` [24,3] m where `bones` [J,4,4] take them: bool [N]."""
    there = (bones[: len(joints), :3, :3] @ joints[..., None])[..., 0] + bones[: len(joints), :3, 3]
    return torch.cdist(means, there).amin(1) < FAR


def _whole(shell: Shell) -> tuple[Shell, int]:
    """A surface without specks and the walls of cavities, and how many specks there are."""
    if len(shell.faces) == 0:
        return shell, 0
    whole = trimesh.Trimesh(*shell, process=False)
    labels = trimesh.graph.connected_component_labels(whole.face_adjacency, node_count=len(whole.faces))
    a, b, c = (whole.vertices[whole.faces[:, k]] for k in range(3))
    solid = np.bincount(labels, (a * np.cross(b, c)).sum(1)) > 0  # the wall of a cavity looks inwards
    speck = solid & (np.bincount(labels, whole.area_faces) < SPECK)
    whole.update_faces((solid & ~speck)[labels])
    whole.remove_unreferenced_vertices()
    return Shell(np.asarray(whole.vertices), np.asarray(whole.faces)), int(speck.sum())


def _fewer(shell: Shell, triangles: int) -> Shell:
    if len(shell.faces) <= triangles:
        return shell
    vertices, faces = simplify(shell.vertices.astype(np.float32), shell.faces.astype(np.int32), target_count=triangles)
    return Shell(vertices.astype(np.float64), faces.astype(np.int64))


def _skin(share: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Four bones [V,4] uint8 of each vertex, and weights [V,4] uint16 that add up to 65535, from `weights` [V,k,J] of Gaussians
    nearby, by their `share` [V,k].
    """
    which, words, _ = heaviest((share[..., None] * weights).sum(1), 4, WORDS)
    return which, words


def _morphs(face: Mien, near: Tensor, rows: np.ndarray, share: np.ndarray) -> np.ndarray:
    """How the shapes move vertices [K,V,3] m: as the Gaussians `rows` [V,k] around them, of those that are `near` [N]."""
    moves = torch.zeros(len(face.moves), len(near), 3)
    moves[:, face.rows] = face.moves.unflatten(1, (-1, 3))
    ours = moves[:, near].numpy()
    return np.stack([(share[..., None] * shape[rows]).sum(1) for shape in ours]).astype(np.float32)

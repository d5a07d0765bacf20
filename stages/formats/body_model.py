"""SMPL, SMPL-H and SMPL-X files (.pkl, .npz), the free body that comes with the program, and body_model.npz of the smpl stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import as_array, checked, npz_names, read_npz, take
from stages.formats.gestures import check_shapes
from stages.formats.smplx_model import FIRST, as_smpl
from stages.formats.tool_pickles import read_named
from stages.gestures import FACE_NAMES, FINGER_NAMES, HandsFace
from stages.records import BETAS, JOINTS, BodyModel

FREE_BODY = Path(__file__).parent.parent / "estimators" / "free_body.npz"

SMPL, FREE = "SMPL", "free body"
"""Bodies for which poses are made."""
HINT = (
    "give SMPL_NEUTRAL.pkl (SMPL 1.0 or 1.1, 24 joints), a model of SMPL-H or SMPL-X, or its .npz, "
    "or leave --body-model out to use the free body"
)
_OTHER_NAMES = {"f": "faces", "weights": "lbs_weights"}
_KEYS = (
    *("v_template", "f", "faces", "shapedirs", "posedirs", "J_regressor", "kintree_table", "weights", "lbs_weights"),
    *("keypoint_regressor", "keypoint_names", "name"),
    *("finger_regressor", "finger_weights", "face_points", "face_shapes"),
)
"""All that is read of an .npz: SMPL-X files hold pickled names too."""
_HAND = 16  # joints of a MANO model


def read_body_model(path: Path | None = None) -> BodyModel:
    """Read a body model: .pkl (runs no pickled code, needs no chumpy) or .npz of SMPL, SMPL-H or SMPL-X, or None: the free body.

    Raises StageError naming the key with its found and wanted shape, or the kind of model that the file is.
    """
    if path is None:
        return _from_arrays(read_npz(FREE_BODY), FREE_BODY, FREE)
    path = Path(path)
    if not path.is_file():
        raise StageError(f"no body model {path}", HINT)
    arrays = _arrays(path) if path.suffix == ".npz" else read_named(path, HINT)
    return _from_arrays(arrays, path, str(arrays["name"]) if "name" in arrays else path.stem)


def write_body_model(path: Path, model: BodyModel) -> None:
    """Write the model as .npz under SMPL's own keys, so that other programs read it."""
    extra: dict[str, Any] = {}
    if model.keypoint_regressor is not None:
        extra = {"keypoint_regressor": model.keypoint_regressor, "keypoint_names": np.array(model.keypoint_names)}
    if model.fingers is not None:
        extra |= vars(model.fingers)
    parents = model.parents.astype(np.int64) % 2**32
    np.savez_compressed(
        path,
        v_template=model.v_template,
        f=model.faces.astype(np.uint32),
        shapedirs=model.shapedirs,
        posedirs=model.posedirs,
        J_regressor=model.J_regressor,
        weights=model.lbs_weights,
        kintree_table=np.stack([parents, np.arange(JOINTS)]).astype(np.uint32),
        name=np.array(model.name),
        **extra,
    )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    arrays = read_npz(path, HINT, _KEYS)
    if "J_regressor" not in arrays:
        facts = [f"it holds {', '.join(npz_names(path)[:20]) or 'nothing'}"]
        raise StageError(f"{path} has no J_regressor", HINT, facts)
    return arrays


def _from_arrays(arrays: Mapping[str, Any], path: Path, name: str) -> BodyModel:
    def get(key: str, *shape: int | None) -> np.ndarray:
        stored = key if key in arrays else _OTHER_NAMES.get(key, key)
        return checked(take(arrays, stored, path, HINT), shape, stored, path, HINT)

    joints = len(np.atleast_1d(as_array(take(arrays, "J_regressor", path, HINT), "J_regressor", path, HINT)))
    if joints == _HAND:
        raise StageError(f"{path} is a MANO model", HINT, [f"it has {joints} joints, not {JOINTS}"])
    v_template = get("v_template", None, 3)
    count = len(v_template)
    shapedirs = get("shapedirs", count, 3, None)
    if shapedirs.shape[2] < BETAS:
        facts = [f"found {count}x3x{shapedirs.shape[2]}, wanted {count}x3x{BETAS} or more"]
        raise StageError(f"shapedirs in {path} has too few shape components", HINT, facts)
    faces = get("f", None, 3).astype(np.int64)
    if faces.size and not 0 <= faces.min() <= faces.max() < count:
        facts = [f"they go from {faces.min()} to {faces.max()}"]
        raise StageError(f"faces in {path} point outside its {count} vertices", HINT, facts)
    weights = get("weights", count, joints if joints in FIRST else JOINTS).astype(np.float64)
    off = np.abs(weights.sum(1) - 1)
    if off.max() > 1e-3 or weights.min() < -1e-6:
        worst = int(off.argmax())
        facts = [f"vertex {worst} sums to {weights[worst].sum():.4f}; the smallest weight is {weights.min():.4g}"]
        raise StageError(f"skinning weights in {path} do not sum to 1", HINT, facts)
    if joints in FIRST:
        arrays = as_smpl(arrays, path, HINT)
    weights = np.clip(get("weights", count, JOINTS).astype(np.float64), 0, None)
    has_keypoints = "keypoint_regressor" in arrays
    return BodyModel(
        v_template=v_template.astype(np.float32),
        faces=faces.astype(np.int32),
        shapedirs=np.ascontiguousarray(shapedirs[..., :BETAS], dtype=np.float32),
        posedirs=get("posedirs", count, 3, 9 * (JOINTS - 1)).astype(np.float32),
        J_regressor=get("J_regressor", JOINTS, count).astype(np.float32),
        lbs_weights=(weights / weights.sum(1, keepdims=True)).astype(np.float32),
        parents=_parents(arrays, path),
        keypoint_regressor=get("keypoint_regressor", None, count).astype(np.float32) if has_keypoints else None,
        keypoint_names=tuple(map(str, take(arrays, "keypoint_names", path, HINT))) if has_keypoints else None,
        fingers=_fingers(get, count, "face_points" in arrays, path) if "finger_weights" in arrays else None,
        name=name,
    )


def _fingers(get: Callable[..., np.ndarray], count: int, faced: bool, path: Path) -> HandsFace:
    """Finger bones of a model of `count` vertices, and its face, of no points where it is not `faced`."""
    points = get("face_points", None, 3) if faced else np.zeros((0, 3))
    shapes = get("face_shapes", None, len(points), 3) if faced else np.zeros((len(FACE_NAMES), 0, 3))
    check_shapes(len(shapes), "face_shapes", path, HINT)
    return HandsFace(
        finger_regressor=get("finger_regressor", len(FINGER_NAMES) + 10, count).astype(np.float32),
        finger_weights=get("finger_weights", count, len(FINGER_NAMES)).astype(np.float32),
        face_points=points.astype(np.float32),
        face_shapes=shapes.astype(np.float32),
    )


def _parents(arrays: Mapping[str, Any], path: Path) -> np.ndarray:
    table = checked(take(arrays, "kintree_table", path, HINT), (2, JOINTS), "kintree_table", path, HINT)
    parents = table[0].astype(np.int64)
    parents[parents == 2**32 - 1] = -1  # the root's -1, unsigned
    joint = np.arange(JOINTS)
    wrong = np.flatnonzero(np.where(joint == 0, parents != -1, (parents < 0) | (parents >= joint)))
    if len(wrong):
        facts = [f"joint {i} has parent {parents[i]}" for i in wrong[:3]]
        raise StageError(f"kintree_table in {path} is not a tree with each parent before its child", HINT, facts)
    return parents.astype(np.int32)

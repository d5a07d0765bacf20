"""body.npz: the body's shape, and its pose in every frame, in the world."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz, take, write_npz
from stages.formats.body_model import SMPL
from stages.formats.gestures import check_shapes
from stages.records import BodyPoses

HINT = "body.npz needs names [F], betas [10], global_orient [F,3], body_pose [F,69], transl [F,3], world_from_sfm"


def whose(arrays: Mapping[str, np.ndarray], path: Path | str) -> str:
    """The body whose poses a file of arrays holds: what its `body` says, "" for a body.npz, which goes with its run, else SMPL."""
    if "body" not in arrays:
        return "" if "world_from_sfm" in arrays else SMPL
    named = np.asarray(arrays["body"])
    if named.shape != () or named.dtype.kind != "U":
        raise StageError(f"body in {path} is no name", HINT, [f"found {named.shape} of {named.dtype}"])
    return str(named)


def write_poses(path: Path, poses: BodyPoses) -> None:
    """Write `poses` as .npz, rotations and translations as float64, without pickles."""
    values = {
        "betas": poses.betas,
        "global_orient": poses.global_orient,
        "body_pose": poses.body_pose,
        "transl": poses.transl,
        "confidence": poses.confidence,
        "world_from_sfm": poses.world_from_sfm,
    }
    if poses.face is not None:
        values["face"] = poses.face
    names: np.ndarray = np.array(poses.names, dtype=np.str_)
    arrays = {"names": names} | {key: np.asarray(value, np.float64) for key, value in values.items()}
    poses_from_arrays(arrays, path)
    write_npz(path, arrays)


def read_poses(path: Path) -> BodyPoses:
    """Read a body.npz; StageError with key, found and wanted shape, or first bad index."""
    return poses_from_arrays(read_npz(path, HINT), path)


def poses_from_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> BodyPoses:
    """As `read_poses`, from arrays; `confidence` may be absent and is then 1, `face` too: it is not known."""
    listed = np.asarray(take(arrays, "names", path, HINT))
    if listed.ndim != 1:
        raise StageError(
            f"names in {path} has the wrong shape", HINT, [f"found {listed.shape}, wanted one for each frame"]
        )
    names = tuple(map(str, listed))
    count = len(names)
    if len(set(names)) != count:
        twice = sorted({name for name in names if names.count(name) > 1})
        raise StageError(
            f"names in {path} are not one for each frame", HINT, [f"more than once: {', '.join(twice[:5])}"]
        )

    def get(key: str, *shape: int | None) -> np.ndarray:
        return checked(take(arrays, key, path, HINT), shape, key, path, HINT).astype(np.float64)

    scale = float(get("world_from_sfm"))
    if not scale > 0:
        raise StageError(f"world_from_sfm in {path} is not a positive scale", HINT, [f"it is {scale}"])
    face = get("face", count, None) if "face" in arrays else None
    if face is not None:
        check_shapes(face.shape[1], "face", path, HINT)
    return BodyPoses(
        names=names,
        betas=get("betas", 10),
        global_orient=get("global_orient", count, 3),
        body_pose=get("body_pose", count, 69),
        transl=get("transl", count, 3),
        confidence=get("confidence", count) if "confidence" in arrays else np.ones(count),
        world_from_sfm=scale,
        face=face,
    )

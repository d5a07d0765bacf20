"""SMPL fits made by other programs: the simple .npz families, brought into one convention and into the world.

| family                      | keys                                                | frame          |
|-----------------------------|-----------------------------------------------------|----------------|
| InstantAvatar, Anim-NeRF    | betas, global_orient, body_pose (or thetas), transl | camera, metres |
| AIST, AMASS-like (SMPL, 72) | betas, poses, trans                                 | camera, metres |
| HUGS and NeuMan             | the first, and scale [N]: X = scale SMPL + transl   | SfM units      |
| ours (body.npz)             | the first, names, world_from_sfm                    | world, metres  |
| ZJU-MoCap (NeuralBody)      | Rh, Th, poses, betas: X = exp(Rh) SMPL + Th         | world, metres  |

Rows belong to frames by `names` (or `frame_ids`). Without, row i is frame number i of the video, never the i-th of a
list.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from stages.contract import StageError
from stages.formats.arrays import checked, read_npz, take
from stages.formats.body_model import BodyModel
from stages.formats.poses import BodyPoses

HINT = (
    "an SMPL fit needs betas [10], global_orient [N,3], body_pose [N,69] (or thetas or poses [N,72]) and transl [N,3]"
)
_NAMES = ("names", "frame_names", "frame_ids", "frame_id", "frames")


@dataclass(frozen=True)
class SmplFit:
    """N poses as their file means them, rotation vectors in radians, one shape.

    `scale` None: in each frame's camera, X_cam = SMPL + transl in metres. `scale` [N]: X_sfm = scale SMPL + transl in
    SfM units. `names` None: row i is frame number i. `turns` [N,3]: rotation vectors, part of `global_orient`, by which
    the posed body was turned about the origin instead of its pelvis. `notes` say what was simplified.
    """

    path: str
    betas: np.ndarray
    global_orient: np.ndarray
    body_pose: np.ndarray
    transl: np.ndarray
    scale: np.ndarray | None = None
    names: tuple[str, ...] | None = None
    turns: np.ndarray | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.transl)

    def rows(self, rows: Sequence[int]) -> SmplFit:
        """The same fit with only these rows."""
        index = list(rows)
        parts = {key: getattr(self, key)[index] for key in ("global_orient", "body_pose", "transl")}
        names = None if self.names is None else tuple(self.names[i] for i in index)
        parts |= {k: v[index] for k in ("scale", "turns") if (v := getattr(self, k)) is not None}
        return replace(self, **parts, names=names)


def read_smpl_fit(path: Path) -> SmplFit:
    """Read any of the families above; StageError with the key, what was found and what was wanted."""
    arrays = read_npz(path, HINT)
    transl_key = next((key for key in ("transl", "trans", "Th") if key in arrays), "transl")
    transl = take(arrays, transl_key, path, HINT)
    count = len(np.atleast_2d(transl))
    transl = checked(transl, (count, 3), transl_key, path, HINT).astype(np.float64)
    pose = _pose(arrays, count, path)
    betas, notes = _betas(arrays, count, path)
    scale = turns = None
    if "Rh" in arrays:
        turns, scale = _rotvecs(arrays["Rh"], count, 1, "Rh", path), np.ones(count)
        both = [_rotvec(cv2.Rodrigues(a)[0] @ cv2.Rodrigues(b)[0]) for a, b in zip(turns, pose[:, :3], strict=True)]
        pose[:, :3] = both
    elif "scale" in arrays:
        scale = checked(arrays["scale"].reshape(-1), (count,), "scale", path, HINT).astype(np.float64)
    elif "world_from_sfm" in arrays:
        world_from_sfm = checked(arrays["world_from_sfm"], (), "world_from_sfm", path, HINT)
        scale, transl = np.full(count, 1 / world_from_sfm), transl / world_from_sfm
    if scale is not None and not (scale > 0).all():
        worst = int(scale.argmin())
        raise StageError(f"scale in {path} is not positive", HINT, [f"row {worst} has {scale[worst]:.4g}"])
    if scale is not None and np.ptp(scale) > 0.01 * scale.mean():
        notes += (
            f"scale varies from {scale.min():.4g} to {scale.max():.4g}; one scale is kept, and depth made to fit",
        )
    return SmplFit(str(path), betas, pose[:, :3], pose[:, 3:], transl, scale, _names(arrays, count, path), turns, notes)


def match_frames(fit: SmplFit, names: Sequence[str]) -> tuple[SmplFit, tuple[str, ...], tuple[str, ...]]:
    """The rows of `fit` that belong to `names`, in their order: (fit of M rows, the M names, the names without a row).

    By name (stem), else by the number in the name. StageError if no frame has a row, or two rows claim one frame.
    """
    if fit.names is None:
        own = {i: i for i in range(len(fit))}
        rows = {name: own.get(_number(name)) for name in names}
    else:
        stems = [Path(name).stem for name in fit.names]
        by_stem, by_number = _index(stems, fit.path), None
        if not set(by_stem) & set(names):
            by_number = _index([_number(stem) for stem in stems], fit.path)
        rows = {name: by_stem.get(name) if by_number is None else by_number.get(_number(name)) for name in names}
    kept = [name for name in names if rows[name] is not None]
    missing = tuple(name for name in names if rows[name] is None)
    few = fit.names is None and len(missing) > len(names) // 2
    if not kept or few:
        has = f"rows 0 to {len(fit) - 1}" if fit.names is None else f"{fit.names[0]} to {fit.names[-1]}"
        facts = [f"the fit has {has} ({len(fit)}), the clip {names[0]} to {names[-1]} ({len(names)})"]
        hint = "add `names` [N] to the file: the frame of each row, as in frames.json (the frame's number in the video)"
        raise StageError(f"{len(missing)} of {len(names)} frames have no row in {fit.path}", hint, facts)
    return replace(fit.rows([rows[name] for name in kept]), names=tuple(kept)), tuple(kept), missing


def place_in_world(
    fit: SmplFit, viewmats: np.ndarray, model: BodyModel, world_from_sfm: float | None = None
) -> BodyPoses:
    """The fit's poses in the world (metres, SfM axes), seen by each frame's camera exactly as in the file.

    `viewmats` [N,4,4] camera_from_sfm in SfM units, row by row. A camera-frame fit needs `world_from_sfm`; an SfM-frame
    fit gives it: one over its median scale, each frame moved along its rays to that scale. Turning a body about the
    camera also moves it, because SMPL turns about the pelvis J0: transl = R^T (J0 + t) - J0 - w R^T T; a body turned about the
    origin by R has t = R J0 - J0 + Th.
    """
    if fit.names is None:
        raise ValueError("match the rows to frames first")
    back, shift = viewmats[:, :3, :3].transpose(0, 2, 1), viewmats[:, :3, 3]
    centres = -(back @ shift[..., None])[..., 0]
    pelvis = model.J_regressor[0].astype(np.float64) @ (model.v_template + model.shapedirs @ fit.betas)
    if fit.scale is not None:
        if fit.turns is not None:
            turned = np.stack([cv2.Rodrigues(turn)[0] @ pelvis for turn in fit.turns])
            fit = replace(fit, transl=fit.transl + fit.scale[:, None] * (turned - pelvis))
        world_from_sfm = 1 / float(np.median(fit.scale))
        orient = fit.global_orient
        transl = (fit.transl - centres) / fit.scale[:, None] + centres * world_from_sfm
    else:
        if world_from_sfm is None:
            raise ValueError("a fit in camera frames needs world_from_sfm")
        _check_in_front(fit, fit.transl + pelvis)
        orient = np.stack([_rotvec(r @ cv2.Rodrigues(v)[0]) for r, v in zip(back, fit.global_orient, strict=True)])
        transl = (back @ (fit.transl + pelvis)[..., None])[..., 0] - pelvis + world_from_sfm * centres
    sure = np.ones(len(fit))
    return BodyPoses(fit.names, fit.betas, orient, fit.body_pose, transl, sure, float(world_from_sfm))


def _check_in_front(fit: SmplFit, pelvis: np.ndarray) -> None:
    behind = np.flatnonzero(pelvis[:, 2] <= 0.1)
    if len(behind):
        i = int(behind[0])
        facts = [f"{len(behind)} of {len(fit)} frames; first {fit.names[i]}: depth {pelvis[i, 2]:.3f} m"]
        hint = "without `scale` the file must be in camera axes (x right, y down, z forward), in metres"
        raise StageError(f"{fit.path} puts the person behind the camera", hint, facts)


def _pose(arrays: Mapping[str, np.ndarray], count: int, path: Path) -> np.ndarray:
    """All 24 rotation vectors [N,72], from whichever layout is there."""
    for key in ("thetas", "poses"):
        if key in arrays:
            return _rotvecs(arrays[key], count, 24, key, path)
    orient = _rotvecs(take(arrays, "global_orient", path, HINT), count, 1, "global_orient", path)
    return np.concatenate([orient, _rotvecs(take(arrays, "body_pose", path, HINT), count, 23, "body_pose", path)], 1)


def _rotvecs(array: np.ndarray, count: int, joints: int, key: str, path: Path) -> np.ndarray:
    size = array.size // max(count, 1)
    if array.shape[:1] == (count,) and size in (156, 165):
        facts = [f"found {count}x{size}: {'SMPL-H' if size == 156 else 'SMPL-X'} with hands"]
        raise StageError(f"{key} in {path} is not an SMPL pose", HINT, facts)
    if array.shape[:1] == (count,) and array.shape[-2:] == (3, 3) and size == joints * 9:
        matrices = checked(array.reshape(count, joints, 3, 3), (count, joints, 3, 3), key, path, HINT).astype(
            np.float64
        )
        off = np.abs(matrices @ matrices.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
        off = np.maximum(off, np.abs(np.linalg.det(matrices) - 1))
        if off.max() > 1e-2:
            row, joint = (int(i) for i in np.unravel_index(off.argmax(), off.shape))
            determinant = np.linalg.det(matrices[row, joint])
            facts = [f"row {row}, joint {joint}: off by {off.max():.3g}, determinant {determinant:.3g}"]
            raise StageError(f"{key} in {path} holds matrices that are not rotations", HINT, facts)
        return np.array([[_rotvec(m) for m in row] for row in matrices]).reshape(count, joints * 3)
    flat = array.reshape(count, -1) if array.ndim == 3 and array.shape[0] == count else array
    flat = checked(flat, (count, joints * 3), key, path, HINT).astype(np.float64)
    angle = np.linalg.norm(flat.reshape(count, joints, 3), axis=-1)
    if angle.size and angle.max() > 4 * np.pi:
        row, joint = (int(i) for i in np.unravel_index(angle.argmax(), angle.shape))
        facts = [f"row {row}, joint {joint} turns by {angle.max():.1f}"]
        raise StageError(f"{key} in {path} looks like degrees", "rotation vectors are in radians", facts)
    return flat


def _rotvec(matrix: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(matrix)[0][:, 0]


def _betas(arrays: Mapping[str, np.ndarray], count: int, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    betas = np.atleast_2d(take(arrays, "betas", path, HINT))
    rows = count if len(betas) == count else 1
    if betas.ndim == 2 and betas.shape[1] > 10:
        betas = betas[:, :10]
    betas = checked(betas, (rows, 10), "betas", path, HINT).astype(np.float64)
    shape, notes = np.median(betas, 0), ()
    if np.ptp(betas, axis=0).max() > 1e-3:
        notes += (f"betas vary by up to {np.ptp(betas, axis=0).max():.2g} over the frames; their median is kept",)
    if np.abs(shape).max() > 5:
        notes += (f"betas reach {np.abs(shape).max():.1f}: an extreme shape",)
    return shape, notes


def _names(arrays: Mapping[str, np.ndarray], count: int, path: Path) -> tuple[str, ...] | None:
    key = next((key for key in _NAMES if key in arrays), None)
    if key is None:
        return None
    if arrays[key].shape != (count,) or arrays[key].dtype.kind not in "USiu":
        facts = [f"found {arrays[key].shape} of {arrays[key].dtype}, wanted {count} texts or whole numbers"]
        raise StageError(f"{key} in {path} does not name its rows", HINT, facts)
    return tuple(name.decode() if isinstance(name, bytes) else str(name) for name in arrays[key].tolist())


def _number(name: str) -> int | None:
    digits = re.findall(r"\d+", name)
    return int(digits[-1]) if digits else None


def _index(keys: Sequence[str | int | None], path: str) -> dict[str | int | None, int]:
    if len(set(keys)) != len(keys):
        twice = sorted({str(key) for key in keys if keys.count(key) > 1})
        raise StageError(f"two rows of {path} name the same frame", HINT, [f"{', '.join(twice[:5])}"])
    return {key: i for i, key in enumerate(keys) if key is not None}

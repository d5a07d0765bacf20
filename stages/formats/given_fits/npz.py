"""Plain SMPL fits: one array a parameter, in .npz.

| family                      | keys                                                | frame          |
|-----------------------------|-----------------------------------------------------|----------------|
| InstantAvatar, Anim-NeRF    | betas, global_orient, body_pose (or thetas), transl | camera, metres |
| AIST, AMASS-like (SMPL, 72) | betas, poses, trans                                 | camera, metres |
| AMASS (156, 165)            | the same of SMPL-H or SMPL-X, mocap_framerate       | camera, metres |
| HUGS and NeuMan             | the first, and scale [N]: X = scale SMPL + transl   | SfM units      |
| ours (body.npz)             | the first, names, world_from_sfm                    | world, metres  |
| ZJU-MoCap (NeuralBody)      | Rh, Th, poses, betas: X = exp(Rh) SMPL + Th         | world, metres  |

Rows belong to frames by `names` (or `frame_ids`), or by time where the file has a frame rate or `times` in seconds.
Poses are SMPL's, but for ours and for files that name another `body`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.arrays import checked, texts
from stages.formats.given_fits.record import OTHER_SHAPE, SMPLX_PELVIS, Fields, SmplFit
from stages.formats.poses import whose

HINT = (
    "an SMPL fit needs betas [10], global_orient [N,3], body_pose [N,69] (or thetas or poses [N,72]) and transl [N,3]"
)
TRANSL = ("transl", "trans", "Th")
_NAMES = ("names", "frame_names", "frame_ids", "frame_id", "frames")
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate")
_HANDS = {156: (22, 37), 165: (25, 40)}
"""Joints of SMPL-H and of SMPL-X at the root of the left and the right middle hand, SMPL's hands; 0 to 21 are SMPL's."""


def read_plain(content: dict[str, Any], path: str) -> SmplFit:
    """Any of the families above; StageError with the key, what was found and what was wanted."""
    file = Fields(content, path, HINT)
    key = next((key for key in TRANSL if key in file), "transl")
    count = len(np.atleast_2d(file.array(key)))
    transl = file.get(key, count, 3)
    if not count:
        raise StageError(f"{path} holds no poses", HINT, [f"{key} has no rows"])
    pose, more = _pose(file, count)
    scale, turns = None, None
    if "Rh" in file:
        turns, scale = file.rotations("Rh", count, 1), np.ones(count)
        pose[:, :3] = (Rotation.from_rotvec(turns) * Rotation.from_rotvec(pose[:, :3])).as_rotvec()
    elif "scale" in file:
        scale = checked(file.array("scale").reshape(-1), (count,), "scale", path, HINT).astype(np.float64)
    elif "world_from_sfm" in file:
        world_from_sfm = file.get("world_from_sfm")
        scale, transl = np.full(count, 1 / world_from_sfm), transl / world_from_sfm
    if scale is not None and not (scale > 0).all():
        worst = int(scale.argmin())
        raise StageError(f"scale in {path} is not positive", HINT, [f"row {worst} has {scale[worst]:.4g}"])
    if scale is not None and np.ptp(scale) > 0.01 * scale.mean():
        varies = f"scale varies from {scale.min():.4g} to {scale.max():.4g}; one scale is kept, and depth made to fit"
        more["notes"] = (*more.get("notes", ()), varies)
    names = _names(file, count)
    times = None if names else _times(file, count)
    return SmplFit(
        path,
        "npz",
        betas=file.betas("betas", count),
        global_orient=pose[:, :3],
        body_pose=pose[:, 3:],
        transl=transl,
        scale=scale,
        turns=turns,
        body=whose(content, path),
        names=names,
        times=times,
        **more,
    )


def _pose(file: Fields, count: int) -> tuple[np.ndarray, dict[str, Any]]:
    """All 24 rotation vectors [N,72] from whichever layout is there, and what else follows for the fit."""
    for key in ("thetas", "poses"):
        if key in file:
            array = file.array(key)
            size = array.size // count
            if array.shape[:1] != (count,) or size not in _HANDS:
                return file.rotations(key, count, 24), {}
            every = file.rotations(key, count, size // 3).reshape(count, -1, 3)
            more: dict[str, Any] = {"notes": (OTHER_SHAPE.format("SMPL-H" if size == 156 else "SMPL-X"),)}
            more |= {"pelvis": SMPLX_PELVIS} if size == 165 else {}
            return every[:, [*range(22), *_HANDS[size]]].reshape(count, 72), more
    orient = file.rotations("global_orient", count, 1)
    return np.concatenate([orient, file.rotations("body_pose", count, 23)], 1), {}


def _names(file: Fields, count: int) -> tuple[str, ...] | None:
    key = next((key for key in _NAMES if key in file), None)
    if key is None:
        return None
    return tuple(texts(np.asarray(file.take(key)), count, key, file.where, HINT))


def _times(file: Fields, count: int) -> np.ndarray | None:
    """The time of each row in s, where the file tells it; the first row of one with a frame rate is at 0."""
    if "times" in file:
        times = file.get("times", count)
        if (np.diff(times) <= 0).any():
            row = int(np.flatnonzero(np.diff(times) <= 0)[0]) + 1
            facts = [f"row {row} is at {times[row]:g} s, the row before at {times[row - 1]:g} s"]
            raise StageError(f"times in {file.where} do not increase", HINT, facts)
        return times
    key = next((key for key in _RATES if key in file), None)
    if key is None:
        return None
    rate = float(checked(file.array(key).reshape(-1), (1,), key, file.where, HINT)[0])
    if not rate > 0:
        raise StageError(f"{key} in {file.where} is not a frame rate", HINT, [f"it is {rate:g}"])
    return np.arange(count) / rate

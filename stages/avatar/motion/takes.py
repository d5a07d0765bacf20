"""Motions as engines play them: joint rotations over time, for the clip's own poses and for made motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stages import records
from stages.avatar.motion.between import between
from stages.avatar.motion.formulas import MOTIONS
from stages.avatar.motion.placing import Soles, face_ahead, filmed, on_floor, seen_in_order

SECONDS, FPS = 4.0, 30.0  # of a made motion


def clip_take(body: records.BodyPoses, times: np.ndarray, ground: records.Ground, soles: Soles) -> records.Take | None:
    """What the person did in the clip; `times` [F] s are those of the poses in `body`. None where nobody was seen.

    Frames without evidence are left out, and so are those not later than one before them (other cameras of a moment).
    It begins where the T-pose stands, looks ahead there, and keeps its feet on the T-pose's floor.
    """
    rows = seen_in_order(body, times)
    if len(rows) == 0:
        return None
    passed = float(np.ptp(times[rows]))
    motion = face_ahead(filmed(body, rows, ground, soles), "y")
    placed = on_floor(motion, (len(rows) - 1) / passed if passed > 0 else 1.0, soles)
    pelvis = placed.transl + soles.joints[0] * [0, 1, 0] + [0, soles.floor, 0]
    pelvis += (soles.joints[0] - pelvis[0]) * [1, 0, 1]
    return take_of("clip", times[rows] - times[rows[0]], placed.global_orient, placed.body_pose, pelvis, placed.hands)


def made_takes(pelvis: np.ndarray) -> list[records.Take]:
    """The motions made by formula, for a body whose pelvis [3] m at rest is given."""
    takes = []
    for name, make in MOTIONS.items():
        turns, poses, places = (part.numpy().astype(np.float64) for part in make(SECONDS, FPS))
        takes.append(take_of(name, np.arange(len(turns)) / FPS, turns, poses, pelvis + places))
    return takes


def take_of(
    name: str,
    times: np.ndarray,
    orient: np.ndarray,
    pose: np.ndarray,
    pelvis: np.ndarray,
    hands: np.ndarray | None = None,
) -> records.Take:
    """The take of rotation vectors orient [F,3], pose [F,69] and `hands` [F,2,15,3] rad, and pelvis [F,3] m, at `times` [F] s."""
    rotvecs = np.concatenate([orient, pose], 1).reshape(-1, 3)
    quats = Rotation.from_rotvec(rotvecs).as_quat(scalar_first=True).reshape(len(times), -1, 4)
    near = np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0)  # q and -q are one turn; players interpolate
    quats[1:] *= np.cumprod(near, axis=0)[..., None]
    return records.Take(name, times, quats, pelvis, hands)


def even(take: records.Take) -> records.Take:
    """The take at its own pace, that of most of its steps: turns slerped, places linear between its poses, the ends kept.

    Clothes are left out, and of fingers only their bones' turns are there.
    """
    if len(take) < 2:
        return replace(take, clothes=None, hands=None)
    steps = max(1, round(take.times[-1] / np.median(np.diff(take.times))))
    times = np.linspace(0, take.times[-1], steps + 1)

    def slerped(quats: np.ndarray) -> np.ndarray:
        turns = [
            Slerp(take.times, Rotation.from_quat(one, scalar_first=True))(times) for one in np.moveaxis(quats, 1, 0)
        ]
        return np.stack([turn.as_quat(scalar_first=True) for turn in turns], 1)

    pelvis = between(times, take.times, take.pelvis)
    fingers = None if take.fingers is None else slerped(take.fingers)
    return records.Take(take.name, times, slerped(take.rotations), pelvis, fingers=fingers)

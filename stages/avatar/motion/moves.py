"""Motions in the world of a clip: the clip's own, and made ones where the person stood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stages import records
from stages.avatar.motion.formulas import upright
from stages.avatar.motion.placing import Soles
from stages.avatar.motion.takes import made_takes


class Spot(NamedTuple):
    """Where a person stands in a clip: `turn` [3,3] from a motion's frame, y up and z ahead, to the world, and `place` [3] m
    on the floor.
    """

    turn: np.ndarray
    place: np.ndarray


def spot_of(body: records.BodyPoses, soles: Soles) -> Spot:
    """Where the person stood in the middle frame. A frame without evidence says nothing of up and floor."""
    middle, present = len(body) // 2, body.confidence > 0
    turn = upright(body.global_orient[present], body.global_orient[middle])
    points, joints = soles.at(body.global_orient, body.body_pose, body.transl)
    up = turn[:, 1]
    floor = np.median((points @ up).min(1)[present])  # a jump in the middle frame does not raise it
    return Spot(turn, joints[middle, 0] + up * (floor - up @ joints[middle, 0]))


def clip_move(body: records.BodyPoses, times: np.ndarray) -> records.Move:
    """What the person did in the clip, a pose a frame, at the mean rate of `times` [F] s (one a second where none pass)."""
    passed = float(np.ptp(times))
    fps = (len(times) - 1) / passed if passed > 0 else 1.0
    return records.Move("In the clip", fps, np.concatenate([body.global_orient, body.body_pose], 1), body.transl)


def made_moves(spot: Spot, soles: Soles) -> list[records.Move]:
    """The motions made by formula, as the body of `soles` performs them on its spot."""
    pelvis = soles.joints[0]
    moves = []
    for take in made_takes(pelvis):
        rotvecs = Rotation.from_quat(take.rotations.reshape(-1, 4), scalar_first=True).as_rotvec()
        rotvecs = rotvecs.reshape(len(take), -1, 3)
        points, _ = soles.at(rotvecs[:1, 0], rotvecs[:1, 1:].reshape(1, -1), take.pelvis[:1] - pelvis)
        floor = points[..., 1].min()  # formulas know no feet
        rotvecs[:, 0] = (Rotation.from_matrix(spot.turn) * Rotation.from_rotvec(rotvecs[:, 0])).as_rotvec()
        steps = spot.place - pelvis + (take.pelvis - [0, floor, 0]) @ spot.turn.T
        fps = 1 / float(np.diff(take.times).mean())
        name = take.name.replace("_", " ").capitalize()
        moves.append(records.Move(name, fps, rotvecs.reshape(len(take), -1), steps))
    return moves

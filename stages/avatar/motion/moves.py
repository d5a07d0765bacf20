"""Motions in the world of a clip: the clip's own, and made ones where the person stood."""

from __future__ import annotations

import numpy as np

from stages import gestures, records
from stages.avatar.motion.formulas import GESTURED, MOTIONS
from stages.avatar.motion.gestures import GESTURES
from stages.avatar.motion.placing import Placed, Soles, put
from stages.avatar.motion.takes import FPS, SECONDS


def clip_move(body: records.BodyPoses, times: np.ndarray) -> gestures.Move:
    """What the person did in the clip, a pose a frame, at the mean rate of `times` [F] s (one a second where none pass)."""
    passed = float(np.ptp(times))
    fps = (len(times) - 1) / passed if passed > 0 else 1.0
    turns = np.concatenate([body.global_orient, body.body_pose], 1)
    return gestures.Move("In the clip", fps, turns, body.transl, body.hands, body.face)


def by_formula(name: str, soles: Soles, seconds: float, fps: float) -> Placed:
    """A motion of MOTIONS or GESTURED for the body of `soles`, its feet on the floor at first: formulas know none."""
    turns, bends, steps = (part.numpy().astype(np.float64) for part in (MOTIONS | GESTURED)[name](seconds, fps))
    points, _ = soles.at(turns[:1], bends[:1], steps[:1])
    steps[:, 1] -= points[..., 1].min()
    hands, face = GESTURES[name](seconds, fps) if name in GESTURED else (None, None)
    return Placed(turns, bends, steps, 0.0, hands, face)


def made_move(
    name: str, ground: records.Ground, soles: Soles, seconds: float = SECONDS, fps: float = FPS
) -> gestures.Move:
    """A motion made by formula, as the body of `soles` performs it on the floor where the person stood."""
    placed = by_formula(name, soles, seconds, fps)
    orient, pose, transl = put(placed, ground.turn, ground.point, soles.joints[0])
    called, turns = name.replace("_", " ").capitalize(), np.concatenate([orient, pose], 1)
    return gestures.Move(called, fps, turns, transl, placed.hands, placed.face)


def made_moves(ground: records.Ground, soles: Soles, gestured: bool) -> list[gestures.Move]:
    """All motions of the body made by formula, as `made_move`, and with `gestured` those of hands and face."""
    return [made_move(name, ground, soles) for name in (MOTIONS | GESTURED if gestured else MOTIONS)]

"""Poses over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stages.avatar.motion.formulas import GESTURED, MOTIONS
from stages.avatar.motion.moves import made_move
from stages.avatar.motion.placing import Soles
from stages.gestures import Move
from stages.records import Ground


class Pose(NamedTuple):
    """A pose of SMPL, or P poses: body_pose [69] or [P,69] and global_orient [3] or [P,3] in rad, transl [3] or [P,3] m.

    It has what `Avatar.pose` takes, in its order: `betas` is None, `hands` [2,15,3] or [P,2,15,3] rad and `face` [52] or [P,52]
    are None where the motion has none.

        person = avatar.pose(*hugs.Pose(np.zeros(69), np.zeros(3), np.array([0.0, 0.0, 1.0])))
    """

    body_pose: np.ndarray
    global_orient: np.ndarray
    transl: np.ndarray
    betas: None = None
    hands: np.ndarray | None = None
    face: np.ndarray | None = None


@dataclass(frozen=True, repr=False)
class Motion:
    """F poses in the world of the avatar, `fps` a second; a row, or a slice of rows, is a `Pose`.

    body_pose [F,69] and global_orient [F,3] rotation vectors in rad, transl [F,3] m. `seen` bool [F]: the fit trusts the pose.
    `hands` [F,2,15,3] rad and `face` [F,52] are None where the motion has none.

        person = avatar.pose(*avatar.motions["clip"][12])
    """

    body_pose: np.ndarray
    global_orient: np.ndarray
    transl: np.ndarray
    fps: float
    seen: np.ndarray
    hands: np.ndarray | None = None
    face: np.ndarray | None = None

    @classmethod
    def of(cls, move: Move, seen: np.ndarray | None = None) -> Motion:
        """The motion of a record."""
        turns, steps = np.asarray(move.rotvecs), np.asarray(move.steps)
        known = np.ones(len(steps), bool) if seen is None else seen
        return cls(turns[:, 3:], turns[:, :3], steps, move.fps, known, move.hands, move.face)

    def __len__(self) -> int:
        return len(self.transl)

    def __getitem__(self, rows: int | slice) -> Pose:
        more = (None if part is None else part[rows] for part in (self.hands, self.face))
        return Pose(self.body_pose[rows], self.global_orient[rows], self.transl[rows], None, *more)

    def __repr__(self) -> str:
        way = np.linalg.norm(np.diff(self.transl, axis=0), axis=1).sum()
        return f"<{len(self)} poses, {len(self) / self.fps:.1f} s at {self.fps:.4g} a second, {way:.1f} m of way>"


class Motions(Mapping[str, Motion]):
    """Motions by name, each made when it is asked for: "clip", where there is one, and those that are made by formula.

    Those with hands and a face are there for people who have them: `gestured`.
    """

    def __init__(self, soles: Soles, ground: Ground, clip: Motion | None, gestured: bool = False):
        self.soles, self.ground, self.clip = soles, ground, clip
        self.made = tuple(MOTIONS | GESTURED if gestured else MOTIONS)

    def __getitem__(self, name: str) -> Motion:
        if name == "clip" and self.clip is not None:
            return self.clip
        if name not in self.made:
            raise KeyError(name)
        return Motion.of(made_move(name, self.ground, self.soles))

    def __iter__(self) -> Iterator[str]:
        return iter([*(["clip"] if self.clip is not None else []), *self.made])

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __repr__(self) -> str:
        return f"<motions: {', '.join(self)}>"

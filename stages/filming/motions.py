"""Motions for the people of a film: read from a file or taken from their clip, on a floor at y = 0, at the film's rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.avatar.motion import placing, retarget
from stages.avatar.motion.hands import FARTHEST, broken, from_smplx
from stages.avatar.motion.placing import Placed, Soles
from stages.avatar.motion.retarget import Performance
from stages.contract import StageError
from stages.formats.body_model import FREE, SMPL
from stages.formats.budget import check_count
from stages.formats.motions import bvh, bvh_names
from stages.formats.motions.bvh_fingers import map_fingers
from stages.formats.motions.rates import usual_rate
from stages.formats.motions.smpl_npz import FILES, read_smpl_motion
from stages.gestures import FACE_NAMES, Face, Fingers
from stages.records import BodyPoses, Ground

DEFAULT_FPS = 30.0  # of a motion file that does not say


@dataclass(frozen=True)
class Manner:
    """How a motion is performed: at `fps` pictures a second, `speed` times as fast as it was.

    `motion_fps`: frames a second of its file in place of what that says. `up`: the axis that points up in the file (y, -y, z,
    -z), in place of the direction in which its pelvis points.
    """

    fps: float
    speed: float = 1.0
    motion_fps: float | None = None
    up: str | None = None

    @property
    def wanted(self) -> float:
        """Pictures of the film for each second of the motion."""
        return self.fps / self.speed


def check_time(seconds: float, wanted: float, where: Path | str) -> None:
    """StageError for a motion that takes so long, or is so slow, that its poses at `wanted` a second are too many."""
    check_count(
        max(seconds, 1.0) * wanted,
        "poses",
        where,
        f"it takes {seconds:.4g} s: cut it, or say its rate with `--motion-fps`",
    )


def from_file(
    path: Path,
    manner: Manner,
    soles: Soles,
    parents: Sequence[int],
    body: str = SMPL,
    fingers: Fingers | None = None,
    face: Face | None = None,
) -> tuple[Placed, list[str]]:
    """A .bvh, or SMPL poses, retargeted to the body of `soles`, and facts about it; StageError for what is no motion.

    `body` is its name: poses of SMPL are carried over to the free body, so that limbs point as SMPL's do. `fingers` and `face`
    are the avatar's, which move as those of the file.
    """
    performance, rate, facts = _read(path, manner.motion_fps, soles, parents, body, fingers, face)
    seen = placing.which_is_up(performance)
    up = manner.up or seen
    if up is None:
        pelvis = ", ".join(f"{x:.2f}" for x in performance.rotations[:, 0, :, 1].mean(0))
        found = [f"the pelvis points along ({pelvis}) on average"]
        raise StageError(f"cannot tell which way is up in {path}", "give it with `--up`: y, -y, z or -z", found)
    check_time((len(performance.hips) - 1) / rate, manner.wanted, path)
    performance = retarget.resample(placing.face_ahead(performance, up), rate, manner.wanted)
    placed = placing.on_floor(performance, manner.wanted, soles)
    facts.append(f"{up} is up")
    if seen and seen != up:
        facts.append(f"the pelvis points along {seen}: `--up {seen}`, or none, if people do not stand on their heads")
    if placed.drift > 0.05:
        facts.append(f"its floor rose and fell by {placed.drift:.2f} m, which is taken out")
    return placed, facts


def from_clip(body: BodyPoses, times: np.ndarray, ground: Ground, manner: Manner, soles: Soles) -> Placed | None:
    """What a person did in their clip, as seen from its floor, where they stood being the origin; None if nobody was seen.

    `times` [F] s are those of the poses in `body`; frames without evidence are left out.
    """
    rows = placing.seen_in_order(body, times)
    if len(rows) == 0:
        return None
    check_time(times[rows[-1]] - times[rows[0]], manner.wanted, "the motion of the clip")
    performance = placing.filmed(body, rows, ground, soles)
    return placing.on_floor(retarget.resample_at(performance, times[rows], manner.wanted), manner.wanted, soles)


def _of_fingers(bones: int, fingers: Fingers | None) -> list[str]:
    """What is said of the finger bones of a file."""
    if bones and fingers is None:
        return ["fingers left out: this avatar has none"]
    return [f"{bones} finger bones"] if bones else []


def _of_face(motion: np.ndarray, face: Face | None) -> tuple[np.ndarray | None, list[str]]:
    """What of the coefficients [F,K] of a motion an avatar's `face` plays, and what is said of them."""
    own, expressions = 0 if face is None else len(face.moves), motion.shape[1] - len(FACE_NAMES)
    if not own:
        return None, ["jaw, eyes and expressions left out: this avatar has no face that moves"]
    said = [f"{min(expressions, own - len(FACE_NAMES))} expressions"] if own > len(FACE_NAMES) and expressions else []
    if motion.shape[1] > own:
        said.append(f"{motion.shape[1] - own} expressions left out: this avatar lacks them")
    played = motion[:, :own]
    if motion[:, : len(FACE_NAMES)].any():
        said.insert(0, "jaw and eyes")
    return played if played.any() else None, said


def _read(
    path: Path,
    fps: float | None,
    soles: Soles,
    parents: Sequence[int],
    body: str,
    fingers: Fingers | None,
    face: Face | None,
) -> tuple[Performance, float, list[str]]:
    """The motion for SMPL's joints, its frames a second (`fps`, if given), and facts about the file in words."""
    own_fps: float | None
    if path.suffix.lower() == ".bvh":
        found = bvh.read_bvh(path)
        named = bvh_names.map_body(found, path)
        skeleton = retarget.Skeleton(found.names, found.parents, found.places, found.rotations)
        chains = (named.limbs, named.pelvis, named.spine, named.neck)
        bones = map_fingers(found, named.limbs)
        hands = (fingers, bones) if fingers is not None and bones else None
        try:
            performance = retarget.from_skeleton(skeleton, *chains, soles.joints, parents, hands)
        except ValueError as error:
            raise StageError(f"{path} has bones without length", bvh.HINT, [str(error)]) from error
        count, used = named.used + len(named.unused), named.used + (len(bones) if hands else 0)
        notes = [f"{used} of {count} joints used", *_of_fingers(len(bones), fingers)]
        lost = 0 if performance.hands is None else broken(performance.hands, bones)
        if lost:
            far = f"{lost} of them turn by more than {np.degrees(FARTHEST):.0f} degrees, as no finger does"
            notes.append(f"{far}: they follow the bone above")
        notes += [*named.said, *found.said]
        length, own_fps = len(found), found.fps
    elif path.suffix.lower() in FILES:
        smpl = read_smpl_motion(path)
        turns, notes = (smpl.rotvecs, smpl.transl, soles.joints), list(smpl.notes)
        carried = body == FREE and smpl.body == SMPL
        performance = retarget.carried_over(*turns, parents) if carried else retarget.from_smpl(*turns)
        if smpl.hands is not None:
            notes += _of_fingers(smpl.hands[0].size // 3, fingers)
            if fingers is not None:
                performance = performance._replace(hands=from_smplx(smpl.hands, fingers))
        if smpl.face is not None:
            played, said = _of_face(smpl.face, face)
            performance, notes = performance._replace(face=played), [*notes, *said]
        length, own_fps = len(smpl), smpl.fps
    else:
        raise StageError(
            f"{path} is no motion",
            "give a .bvh, or an .npz, .pkl or .pt of SMPL poses",
            [f"it ends in {path.suffix!r}"],
        )
    rate = usual_rate(f"{fps:.10g}") if fps else own_fps
    if rate is None:
        rate = DEFAULT_FPS
        notes.append(f"no frame rate in the file: {rate:g} frames a second taken (`--motion-fps`)")
    return performance, rate, [f"{length} frames, {(length - 1) / rate:.1f} s at {rate:.4g} fps", *notes]

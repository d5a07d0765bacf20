"""Who is in a film: each person's Gaussians, motion in the film's world, and what casts their shadow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from stages import records
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import Baked, PosedAvatar, load_avatar
from stages.avatar.drawing.rig import rig_of
from stages.avatar.effects.shadow import Casters
from stages.avatar.motion.between import between
from stages.avatar.motion.formulas import GESTURED, MOTIONS
from stages.avatar.motion.moves import by_formula
from stages.avatar.motion.placing import Placed, Soles, put
from stages.avatar.motion.takes import SECONDS
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import with_gain
from stages.contract import StageError
from stages.filming.clip_cast import completed
from stages.filming.motions import Manner, check_time, from_clip, from_file
from stages.filming.spec import Person
from stages.formats.body_model import read_body_model
from stages.formats.exchange.read import lacks, read_any_avatar
from stages.formats.facts import Listing, read_facts
from stages.formats.ground import read_ground
from stages.formats.hands import hands_in, with_hands
from stages.formats.motions.face_csv import read_face
from stages.formats.people import folder_of, model_of
from stages.formats.poses import read_poses
from stages.formats.splats import read_avatar
from stages.formats.trained import trained_of

SAME = 0.005  # m: joints nearer than that to the free body's are its own


@dataclass(frozen=True)
class Actor:
    """One person of a film.

    `global_orient` [P,3], `body_pose` [P,69] and `transl` [P,3] m are the poses of their motion, `fps` a second, in the film's
    world, as if they were as large as they are; `scale` enlarges about `place` [3] m on the floor. `first` is the picture at
    which the motion begins. `gain` [3] is what their colours are multiplied by. `model` is the body
    that they were learned on, None where that is not known.
    """

    name: str
    record: records.Avatar
    model: records.BodyModel | None
    rig: records.Rig
    baked: Baked
    soles: Soles
    placed: Placed
    global_orient: np.ndarray
    body_pose: np.ndarray
    transl: np.ndarray
    place: np.ndarray
    turn: np.ndarray
    scale: float
    fps: float
    first: int
    loop: bool
    facts: tuple[str, ...]
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def row(self, picture: int) -> int:
        """Which pose of the motion a picture shows: the first before it begins, the last when it has ended, unless it loops."""
        row, count = picture - self.first, len(self.transl)
        return row % count if self.loop else min(max(row, 0), count - 1)

    def pose(self, picture: int) -> tuple[np.ndarray | None, ...]:
        """The pose that a picture shows: of the body, of hands and of the face, None where these do not move."""
        parts = self.global_orient, self.body_pose, self.transl, self.placed.hands, self.placed.face
        return tuple(None if part is None else part[self.row(picture)] for part in parts)

    def cloth(self, picture: int) -> torch.Tensor:
        """The bones of their clothes [K,4,4] that a picture shows."""
        first, count = len(self.baked.parents), 0 if self.baked.clothing is None else len(self.baked.clothing)
        return self.posed.bones[self.row(picture), first : first + count]

    def shown(self, picture: int) -> bool:
        """Always: a person of a film is in all its pictures."""
        return True

    def means(self, picture: int) -> None:
        """Not known: a film's pictures have no motion blur."""

    def splats(self, picture: int) -> Splats:
        """Their Gaussians in the film's world, in even light."""
        shown = self.posed.splats(self.row(picture))
        if self.scale == 1:
            return shown
        about = torch.as_tensor(self.place).to(shown.means)
        return shown._replace(means=about + self.scale * (shown.means - about), axes=self.scale * shown.axes)

    def casters(self, picture: int) -> Casters:
        """What casts their shadow."""
        middles, covariances = self.posed.casters(self.row(picture))
        about = torch.as_tensor(self.place).to(middles)
        return Casters(about + self.scale * (middles - about), self.scale**2 * covariances)

    def joints(self, pictures: Sequence[int]) -> np.ndarray:
        """Joints [N,24,3] m in the film's world."""
        rows = [self.row(picture) for picture in pictures]
        _, joints = self.soles.at(self.global_orient[rows], self.body_pose[rows], self.transl[rows])
        return self.place + self.scale * (joints - self.place)

    def start(self, ground: records.Ground) -> tuple[float, float]:
        """Where their motion begins, m on the floor to the left and ahead of their place."""
        left, _, forward = (self.joints([self.first])[0, 0] - self.place) @ ground.turn
        return float(left), float(forward)

    @cached_property
    def posed(self) -> PosedAvatar:
        """The person in each pose of the motion, as large as they are."""
        hands, face = self.placed.hands, self.placed.face
        return PosedAvatar.of(self.baked, self.global_orient, self.body_pose, self.transl, hands=hands, face=face)


def cast(person: Person, name: str, ground: records.Ground, fps: float, device: str) -> Actor:
    """Read a person and let them perform on the `ground` of the film; StageError for what cannot be read or performed."""
    run = person.avatar if person.avatar.is_dir() else None
    if run is None and person.who > 1:
        raise StageError(f"{person.avatar} holds one person: there is no person {person.who}", "leave out `who:`")
    own = None if run is None else trained_of(run / "train", person.who)
    record = read_avatar(own / "avatar.npz") if own else read_any_avatar(person.avatar)
    model = body_of(run, record, person.who)
    record = completed(record, model)
    rig, baked = rig_of(record), load_avatar(record, device)
    soles = Soles.of_rig(rig)
    manner = Manner(fps, person.speed, person.motion_fps, person.up)
    if person.motion in MOTIONS | GESTURED:
        check_time(SECONDS, manner.wanted, person.motion)
        if round(SECONDS * manner.wanted) < 2:
            shown = [f"{SECONDS:g} s, {person.speed:g} times as fast, at {fps:g} pictures a second"]
            raise StageError(
                f"{person.motion} is over before its second picture", "a lower `speed:`, or more `fps:`", shown
            )
        placed, facts = by_formula(person.motion, soles, SECONDS, manner.wanted), []
        lacking = [
            f"no {what}" for what, has in (("fingers", record.fingers), ("face that moves", record.face)) if has is None
        ]
        if person.motion in GESTURED and lacking:
            facts = [f"{person.motion} is played in part: {name} has {' and '.join(lacking)}"]
    elif person.motion != "clip":
        path = Path(person.motion)
        whose = model.name if model else ""
        placed, told = from_file(path, manner, soles, rig.parents.tolist(), whose, record.fingers, record.face)
        facts = [f"{path.name}  {'; '.join(told)}"]
    else:
        placed, facts = _own(run, person, manner, soles), []
    if person.face is not None:
        placed, told = _with_face(placed, person, record, fps)
        facts = [*facts, *told]
    angle = np.radians(person.turn)
    about = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turn = ground.turn @ about
    left, forward = person.at or (0.0, 0.0)
    place = ground.point + ground.turn @ np.array([left, 0, forward])
    orient, pose, transl = put(placed, turn, place, soles.joints[0])
    return Actor(
        name=name,
        record=record,
        model=model,
        rig=rig,
        baked=baked,
        soles=soles,
        placed=placed,
        global_orient=orient,
        body_pose=pose,
        transl=transl,
        place=place,
        turn=turn,
        scale=person.scale,
        fps=fps,
        first=round(person.start * fps),
        loop=person.loop,
        facts=(*facts, *(() if run else lacks(person.avatar, None))),
    )


def moved(actor: Actor, way: np.ndarray) -> Actor:
    """The same person, `way` [3] m from where they were."""
    return replace(actor, place=actor.place + way, transl=actor.transl + way)


def in_colour(actor: Actor, gain: np.ndarray) -> Actor:
    """The same person, their colours multiplied by `gain` [3]."""
    resting = actor.baked.resting
    sh = with_gain(resting.sh, torch.as_tensor(gain).to(resting.sh))
    red, green, blue = (float(value) for value in gain)
    return replace(actor, baked=actor.baked._replace(resting=resting._replace(sh=sh)), gain=(red, green, blue))


def _with_face(placed: Placed, person: Person, record: records.Avatar, fps: float) -> tuple[Placed, list[str]]:
    """The motion with the face of a capture, from its first picture on, `person.speed` times as fast; it ends as it ends."""
    path = Path(person.face or "")
    if record.face is None:
        raise StageError(f"{person.avatar} has no face that moves", "leave out the face, or train it again")
    take = read_face(path)
    shown = np.arange(len(placed.transl)) / fps * person.speed
    face = between(shown, take.times, take.face)
    told = f"{len(take.times)} rows, {take.times[-1]:.1f} s"
    return placed._replace(face=face), [f"{path.name}  {'; '.join([told, *take.notes])}"]


def _own(run: Path | None, person: Person, manner: Manner, soles: Soles) -> Placed:
    """What a person of a run did in their clip."""
    if run is None:
        hint = "give them a motion: `motion: moves.bvh`"
        raise StageError(
            f"{person.avatar} has no clip whose motion could be used", hint, ["an exported avatar holds no motion"]
        )
    body = read_poses(trained_of(run / "train", person.who) / "body.npz")
    body = with_hands(body, hands_in(folder_of(run / "smpl", person.who)))
    times = np.array(read_facts(run / "frames" / "frames.json", Listing).times(body.names))
    placed = from_clip(body, times, read_ground(run / "smpl" / "ground.json"), manner, soles)
    if placed is None:
        raise StageError(f"nobody is seen in the clip of {run}", "give them a motion: `motion: moves.bvh`")
    return placed


def body_of(run: Path | None, record: records.Avatar, who: int = 1) -> records.BodyModel | None:
    """The body of a person of the run, or of a file the free body, of any size, where its joints are that one's, else None."""
    if run:
        return read_body_model(model_of(run / "smpl", who))
    free, theirs = read_body_model(), np.asarray(record.joints, np.float64)
    joints = Body(free).rest_joints(torch.as_tensor(record.betas).float()).double().numpy()
    sizes = 1.0, float(np.linalg.norm(theirs - theirs[0]) / np.linalg.norm(joints - joints[0]))
    near = (size for size in sizes if np.linalg.norm(size * joints - theirs, axis=1).max() < SAME)
    return next((free.sized(size) for size in near), None)

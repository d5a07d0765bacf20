"""The people of one trained clip in its frames: each an avatar of their own, in one scene and one light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import load_avatar
from stages.avatar.drawing.draw import Learned, load_learned, motion_at, pose_of
from stages.avatar.effects.shadow import Casters, Stance, casters
from stages.avatar.effects.speeds import FrameMotion
from stages.avatar.splats.gaussians import Splats
from stages.formats.clip import Clip, load_people
from stages.formats.people import folder_of
from stages.formats.splats import read_avatar
from stages.formats.trained import read_trained
from stages.records import BodyModel, Ground, Rig


class Member(NamedTuple):
    """A person of a clip: the `clip` with their body and their own masks, and what was `learned` of them."""

    clip: Clip
    learned: Learned

    def stance(self, i: int) -> Stance:
        """How they stand in frame `i`, for the shadow."""
        return self.learned.stance(pose_of(self.clip.body, i))

    def splats(self, i: int) -> Splats:
        """Their Gaussians in frame `i`."""
        return self.learned.person(pose_of(self.clip.body, i))

    def motion(self, i: int) -> FrameMotion | None:
        """How they and the camera move at frame `i`; None where no effect needs it."""
        clip = self.clip
        there = clip.shows_person(i)
        return motion_at(self.learned, clip.world_cameras, clip.split.moments, clip.body, i, there)


def load_company(sfm: Path, smpl: Path, train: Path, device: str) -> list[Member]:
    """The people whom a training left, the first one first."""
    first, *others = load_people(sfm, smpl, train)
    members = [Member(first, load_learned(*read_trained(train), device))]
    for clip in others:
        avatar = load_avatar(read_avatar(folder_of(train, clip.person) / "avatar.npz"), device)
        learned = members[0].learned._replace(avatar=avatar)
        members.append(Member(clip, casting(learned, clip.body_model, clip.body.betas)))
    return members


def casting(learned: Learned, model: BodyModel, betas: np.ndarray) -> Learned:
    """The same, their shadow cast by a body of their own and not by that of the clip's first person."""
    joints = learned.avatar.joints
    return learned._replace(parts=Casters(*(part.to(joints) for part in casters_of(model, betas))))


def casters_of(model: BodyModel, betas: np.ndarray) -> Casters:
    """What of a body casts a shadow, at rest."""
    body = Body(model)
    vertices, _ = body.rest(torch.as_tensor(betas).float())
    return casters(vertices, body.lbs_weights)


def floor_under(clip: Clip, rig: Rig, ground: Ground) -> Ground:
    """The floor, its point under where the clip's `person` stands in the middle of the clip; the first's is that of `ground`."""
    if clip.person == 1:
        return ground
    hips = clip.body.transl[len(clip.names) // 2] + rig.joints[0]
    return replace(ground, point=hips - ((hips - ground.point) @ ground.up) * ground.up)


def present(members: Sequence[Member], i: int) -> list[Member]:
    """Those whom frame `i` shows."""
    return [member for member in members if member.clip.shows_person(i)]


def moving(motion: FrameMotion | None, each: Sequence[tuple[Splats, FrameMotion | None]]) -> FrameMotion | None:
    """The motion of several people drawn as one set; `motion` is that of the camera."""
    if motion is None or len(each) < 2:
        return motion if motion is None or not each else each[0][1]
    speeds = [torch.zeros_like(s.means) if m is None or m.person is None else m.person for s, m in each]
    return motion._replace(person=torch.cat(speeds))

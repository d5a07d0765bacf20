"""A trained avatar with its scene and effects, posed and drawn as tests need it: through a `Cast`, one pose at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from stages import records
from stages.avatar.drawing.avatar import Baked, PosedAvatar, bones_of, load_avatar, posed_by
from stages.avatar.drawing.cast import Cast, Moment
from stages.avatar.effects.frames import FrameEffects, load_effects
from stages.avatar.model.scene import load_scene
from stages.avatar.rasterize import Camera, Layer, Rendering
from stages.avatar.splats.compose import draw_together
from stages.avatar.splats.gaussians import Splats
from stages.filming.clip_cast import completed
from stages.formats.body_model import read_body_model

Pose = tuple[np.ndarray, np.ndarray, np.ndarray]  # global_orient [3], body_pose [69] in rad, transl [3] in m


def pose_avatar(avatar: Baked, global_orient: torch.Tensor, body_pose: torch.Tensor, transl: torch.Tensor) -> Splats:
    """The avatar in the world at one pose: global_orient[3], body_pose[69] axis-angle, transl[3] m."""
    return posed_by(avatar, bones_of(avatar, global_orient, body_pose), transl)


@dataclass(frozen=True)
class Learned:
    avatar: Baked
    scene: Splats | None
    effects: FrameEffects

    @torch.no_grad()
    def person(self, pose: Pose, hands: np.ndarray | None = None, face: np.ndarray | None = None) -> Splats:
        """The person's Gaussians in the world, in the light of the clip, with `hands` [2,15,3] rad and `face` [52]."""
        gestures = (None if part is None else part[None] for part in (hands, face))
        posed = PosedAvatar.of(self.avatar, *pose, **dict(zip(("hands", "face"), gestures)))
        return Cast([posed], None, self.effects).at(0).people[0]

    @torch.no_grad()
    def shade(self, scene: Splats | None, pose: Pose | None) -> Splats | None:
        """A scene with the shadow of the person at a pose, None for nobody."""
        people = [] if pose is None else [PosedAvatar.of(self.avatar, *pose)]
        return Cast(people, scene, self.effects).at(0).scene


def load_learned(
    avatar: records.Avatar, scene: records.Scene | None, effects: records.Effects, device: str = "cpu"
) -> Learned:
    drawn = None if scene is None else load_scene(scene, device)
    whole = completed(avatar, read_body_model()) if effects.light is not None else avatar
    return Learned(load_avatar(whole, device), drawn, load_effects(effects).to(device))


def pose_of(body: records.BodyPoses, i: int) -> Pose:
    return body.global_orient[i], body.body_pose[i], body.transl[i]


def draw(
    human: Splats | None, scene: Splats | None, camera: Camera, background: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H,W,3] over a grey `background` and coverage [H,W] at one instant."""
    return Moment([] if human is None else [human], scene).picture(camera, background)


def compose(
    human: Splats | None, scene: Splats | None, camera: Camera, layers: Sequence[Layer] = (Layer(),)
) -> list[Rendering]:
    """Person and scene, where they are, drawn together."""
    return draw_together([one for one in (human, scene) if one is not None], camera, layers)

"""Draws a trained avatar and scene as arrays: no network, no gradient."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from stages import records
from stages.avatar.drawing.avatar import Baked, load_avatar, moving, pose_avatar
from stages.avatar.effects.frames import FrameEffects, load_effects
from stages.avatar.effects.shadow import Casters, Stance
from stages.avatar.effects.speeds import FrameMotion, Speeds
from stages.avatar.model.scene import load_scene
from stages.avatar.rasterize import Camera, Layer
from stages.avatar.splats.gaussians import Splats

Pixels = TypeVar("Pixels", np.ndarray, torch.Tensor)
Pose = tuple[np.ndarray, np.ndarray, np.ndarray]  # global_orient [3], body_pose [69] in rad, transl [3] in m


class Learned(NamedTuple):
    """A trained avatar, its scene (None where only the person was trained) and the effects of their clip.

    `parts` cast the avatar's shadow, where they are not the clip's first person.
    """

    avatar: Baked
    scene: Splats | None
    effects: FrameEffects
    parts: Casters | None = None

    def person(self, pose: Pose) -> Splats:
        """The person's Gaussians in the clip's world at one pose, in its light."""
        posed = pose_avatar(self.avatar, *(torch.as_tensor(part).to(self.avatar.joints) for part in pose))
        return self.effects.lit(posed)

    def shade(self, scene: Splats | None, pose: Pose | None) -> Splats | None:
        """A scene, ours or another, with the shadow of the person at a pose, None for nobody."""
        if pose is None:
            return scene
        return self.effects.shade(scene, self.stance(pose))

    def stance(self, pose: Pose) -> Stance:
        """How the person stands at a pose, for the shadow."""
        joints = self.avatar.joints
        orient, body_pose, transl = (torch.as_tensor(part).to(joints) for part in pose)
        return Stance(joints, self.avatar.parents, orient, body_pose, transl, self.parts)


def load_learned(
    avatar: records.Avatar, scene: records.Scene | None, effects: records.Effects, device: str = "cpu"
) -> Learned:
    """Tensors on `device`; `scene` is None where only the person was trained."""
    drawn = None if scene is None else load_scene(scene, device)
    return Learned(load_avatar(avatar, device), drawn, load_effects(effects).to(device))


def pose_of(body: records.BodyPoses, i: int) -> Pose:
    """The person's pose in frame `i`."""
    return body.global_orient[i], body.body_pose[i], body.transl[i]


def motion_at(
    learned: Learned,
    cameras: records.Cameras,
    moments: np.ndarray,
    body: records.BodyPoses,
    i: int,
    shows_person: bool,
) -> FrameMotion | None:
    """The motion at frame `i` of F, taken by `cameras` in metres at `moments` int[F]; None where no effect needs it."""
    if not learned.effects.takes_time:
        return None
    Ks = torch.as_tensor(cameras.Ks).to(learned.avatar.joints)
    speeds = Speeds(cameras.viewmats, Ks, cameras.height, moments, body.confidence > 0)
    return speeds.at(i, (lambda j: learned.person(pose_of(body, j)).means) if shows_person else None)


def draw(
    human: Splats | None,
    scene: Splats | None,
    camera: Camera,
    background: float = 0.0,
    effects: FrameEffects | None = None,
    motion: FrameMotion | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H,W,3] over a grey `background` and coverage [H,W], float32.

    Draws a single moment, unless `effects` take time and a `motion` is given.
    """
    first = human or scene
    if first is None:
        raise ValueError("there is neither a person nor a scene to draw")
    like = first.means
    layer = Layer(background=torch.full((3,), background).to(like))
    with torch.no_grad():
        (drawn,) = (effects or FrameEffects()).draw(human, scene, motion, camera.to(like), [layer])
    return drawn.image.cpu().numpy(), drawn.alpha.cpu().numpy()


def exposed(image: Pixels, alpha: Pixels, ground: Pixels | float, gain: Pixels) -> Pixels:
    """Colours [H,W,3] of an `image` over a `ground`, covered by `alpha` [H,W]; `gain` [3] is of all but the ground."""
    bare = (1 - alpha)[..., None] * ground
    return bare + gain * (image - bare)


def perform(
    learned: Learned,
    scene: Splats | None,
    poses: tuple[np.ndarray, np.ndarray, np.ndarray],
    cameras: Iterable[Camera],
) -> Iterator[np.ndarray]:
    """Pictures of the person in each of `poses`: global_orient [F,3], body_pose [F,69], transl [F,3]; a camera each."""
    people = moving(learned.avatar, *(torch.as_tensor(part).to(learned.avatar.joints) for part in poses))
    for human, there, camera in zip(people, zip(*poses, strict=True), cameras, strict=True):
        drawn = draw(learned.effects.lit(human), learned.shade(scene, there), camera, background=0.0 if scene else 1.0)
        yield to_uint8(drawn[0])


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Values in 0..1 as bytes, clipped and rounded; raises ValueError when one is not finite."""
    if not np.isfinite(image).all():
        raise ValueError(f"{(~np.isfinite(image)).sum()} values of a picture are not finite")
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)

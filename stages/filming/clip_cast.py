"""The cast of a trained clip: each of its people an avatar of their own, in one scene and one light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import PosedAvatar, load_avatar
from stages.avatar.drawing.cast import Cast
from stages.avatar.drawing.rig import rig_of
from stages.avatar.effects.frames import load_effects
from stages.avatar.effects.shadow import casters
from stages.avatar.effects.speeds import Speeds
from stages.avatar.model.scene import load_scene
from stages.avatar.motion.placing import SOLID
from stages.formats.clip import Clip, load_people
from stages.formats.splats import read_avatar
from stages.formats.trained import read_trained, trained_of
from stages.records import Avatar, BodyModel, Ground, Rig


def load_cast(sfm: Path, smpl: Path, train: Path, device: str) -> tuple[list[Clip], Cast[PosedAvatar]]:
    """The clip with the body of each of its people, and the people as training left them, in the same order."""
    clips = load_people(sfm, smpl, train)
    avatar, scene, learned = read_trained(train)
    avatars = [avatar, *(read_avatar(trained_of(train, clip.person) / "avatar.npz") for clip in clips[1:])]
    people = [posed_as(*one, device) for one in zip(clips, avatars, strict=True)]
    effects, clip, speeds = load_effects(learned).to(device), clips[0], None
    if effects.takes_time:
        Ks = torch.as_tensor(clip.Ks).to(people[0].transl)
        speeds = Speeds(clip.viewmats, Ks, clip.height, clip.split.moments)
    return clips, Cast(people, None if scene is None else load_scene(scene, device), effects, speeds)


def posed_as(clip: Clip, avatar: Avatar, device: str) -> PosedAvatar:
    """An avatar in the poses of the clip's `person`, shown where their mask is."""
    body, baked = clip.body, load_avatar(with_casters(avatar, clip.body_model), device)
    posed = PosedAvatar.of(baked, body.global_orient, body.body_pose, body.transl)
    return replace(posed, known=body.confidence > 0, shows=clip.shows_person)


def with_casters(avatar: Avatar, model: BodyModel | None) -> Avatar:
    """An avatar that casts a shadow: as its file holds, else as its body, or, where that is not known, its Gaussians."""
    if avatar.casters is not None:
        return avatar
    if model is not None:
        body = Body(model)
        vertices, _ = body.rest(torch.as_tensor(avatar.betas).float())
        parts = casters(vertices, body.lbs_weights)
    else:
        rig = rig_of(avatar)
        solid = rig.opacities > SOLID
        parts = casters(torch.as_tensor(rig.means[solid]), torch.as_tensor(avatar.limb_weights[solid]).float())
    return replace(avatar, casters=(parts.middles.numpy(), parts.covariances.numpy()))


def floor_under(clip: Clip, rig: Rig, ground: Ground) -> Ground:
    """The floor, its point under where the clip's `person` stands in the middle of the clip; the first's is that of `ground`."""
    if clip.person == 1:
        return ground
    hips = clip.body.transl[len(clip.names) // 2] + rig.joints[0]
    return replace(ground, point=hips - ((hips - ground.point) @ ground.up) * ground.up)

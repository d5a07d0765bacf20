"""The cast of a trained clip: each of its people an avatar of their own, in one scene and one light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import normalize

from stages.avatar.body.skinning import skin
from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.drawing.avatar import PosedAvatar, load_avatar
from stages.avatar.drawing.cast import Cast
from stages.avatar.drawing.rig import rig_of
from stages.avatar.effects.frames import load_effects
from stages.avatar.effects.shadow import casters
from stages.avatar.effects.speeds import Speeds
from stages.avatar.model.person import bone_transforms
from stages.avatar.model.scene import load_scene
from stages.avatar.motion.placing import SOLID
from stages.avatar.splats.neighbours import mean_near
from stages.formats.body_model import read_body_model
from stages.formats.clip import Clip, load_people
from stages.formats.splats import read_avatar
from stages.formats.trained import read_trained, trained_of
from stages.records import Avatar, BodyModel, Ground, Rig

AROUND = 6  # vertices of the skin that say where a Gaussian faces


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
    """An avatar in the poses of the clip's `person`, with their fingers and their face, shown where their mask is."""
    body, baked = clip.body, load_avatar(completed(avatar, clip.body_model), device)
    hands = body.hands if avatar.fingers is not None else None
    posed = PosedAvatar.of(baked, body.global_orient, body.body_pose, body.transl, hands=hands, face=body.face)
    return replace(posed, known=body.confidence > 0, shows=clip.shows_person)


def completed(avatar: Avatar, model: BodyModel | None) -> Avatar:
    """An avatar that casts a shadow and has normals: as its file holds, else as its body, or, where that is not known, its
    Gaussians cast the shadow, and the free body has the normals.
    """
    whole = avatar if avatar.casters is not None else _with_casters(avatar, model)
    return whole if avatar.normals is not None else replace(whole, normals=_normals(avatar, model))


def _normals(avatar: Avatar, model: BodyModel | None) -> np.ndarray:
    """Normals [N,3] of the skin nearest to the Gaussians of an avatar, in its canonical pose."""
    known = model or read_body_model()
    body, betas, faces = Body(known), torch.as_tensor(avatar.betas).float(), torch.as_tensor(known.faces).long()
    vertices, joints = body.rest(betas if model else torch.zeros_like(betas))
    theirs = torch.as_tensor(avatar.joints).float()
    size = (theirs - theirs[0]).norm() / (joints - joints[0]).norm()
    vertices = theirs[0] + size * (vertices - joints[0])
    pose = torch.as_tensor(avatar.canonical_pose).float()
    bones = bone_transforms(theirs, body.parents, torch.zeros(3), pose)
    posed = skin(vertices, body.lbs_weights, bones)[0]
    means = torch.as_tensor(avatar.means).float()
    return normalize(mean_near(vertex_normals(posed, faces), posed, means, AROUND), dim=1).numpy()


def _with_casters(avatar: Avatar, model: BodyModel | None) -> Avatar:
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

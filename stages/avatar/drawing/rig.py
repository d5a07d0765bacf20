"""A trained avatar for engines that skin with four bones: in the T-pose, as arrays."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import normalize

from stages import gestures, records
from stages.avatar.body.fingers import finger_bones
from stages.avatar.body.skinning import MOST, WORDS, heaviest
from stages.avatar.body.stretch import cloth_of
from stages.avatar.drawing.avatar import Gloves, gloved, load_avatar
from stages.avatar.splats.factor import factored
from stages.avatar.splats.gaussians import Splats

STEEP = 12  # bones, at most, whose slopes are kept: the others together have 0.03 % of a skirt's


def rig_of(avatar: records.Avatar) -> records.Rig:
    """The avatar in the T-pose, in which the transforms of all bones are the identity: not the canonical da-pose.

    Where weights mix, skinning from the T-pose is what the avatar was trained with, and from any other pose it is not.
    """
    baked = load_avatar(avatar)
    at_rest, fingered = baked.resting, baked if baked.gloves is None else gloved(baked)
    resting = factored(
        Splats(at_rest.means, at_rest.axes, at_rest.opacities, at_rest.sh, at_rest.rotations, avatar.antialias)
    )
    all_weights = np.asarray(avatar.lbs_weights, np.float64)
    bones, weights, kept = heaviest(all_weights)
    bones8, words8, _ = heaviest(fingered.resting.weights.double().numpy(), MOST, WORDS)
    return records.Rig(
        **vars(resting),
        joints=np.asarray(avatar.joints, np.float32),
        parents=np.asarray(avatar.parents, np.int32),
        bones=bones,
        weights=weights,
        kept=kept,
        bones8=bones8,
        words8=words8,
        facing=normalize(at_rest.normals, dim=1).cpu().numpy(),
        betas=np.asarray(avatar.betas, np.float32),
        clothes=avatar.clothes,
        slopes=_slopes(at_rest.means, at_rest.weights, len(avatar.joints)),
        fingers=avatar.fingers,
        finger_joints=None if avatar.fingers is None else _lying(avatar.fingers),
    )


def weights_of(avatar: records.Avatar) -> np.ndarray:
    """All skinning weights of the avatar, rows summing to 1: [N,24+K], and with fingers [N,24+K+30]."""
    if avatar.fingers is None:
        return avatar.lbs_weights
    return Gloves.of(avatar.fingers, "cpu").weights(torch.as_tensor(avatar.lbs_weights).float()).numpy()


def _lying(fingers: gestures.Fingers) -> np.ndarray:
    """Joints and tips [40,3] m of fingers in the pose in which the hands lie in the avatar."""
    joints, tips, shape = (torch.as_tensor(part).double() for part in (fingers.joints, fingers.tips, fingers.shape))
    bones = finger_bones(joints, shape, torch.eye(4).double().expand(24, 4, 4))
    points, bones = torch.cat([joints, tips]), torch.cat([bones, bones[2::3]])
    return ((bones[:, :3, :3] @ points[..., None])[..., 0] + bones[:, :3, 3]).numpy()


def _slopes(means: torch.Tensor, weights: torch.Tensor, bones: int) -> records.Slopes | None:
    cloth = cloth_of(means, weights, bones)
    if cloth is None:
        return None
    slopes = cloth.slopes(weights)
    steepest = slopes.norm(dim=2).topk(min(STEEP, slopes.shape[1]), dim=1).indices
    chosen = slopes.take_along_dim(steepest[..., None], 1)
    return records.Slopes(cloth.rows.numpy(), steepest.numpy().astype(np.uint8), chosen.numpy())

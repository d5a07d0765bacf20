"""The person as Gaussians: in the canonical pose, in the rest pose of their skeleton, and posed in the world."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.skinning import FewBones, skin
from stages.avatar.body.smpl import rest_relative_transforms
from stages.avatar.body.stretch import Stretch
from stages.avatar.kernels.products import products, turned
from stages.avatar.splats.gaussians import Splats


class Canonical(NamedTuple):
    """The person at the da-pose: means[N,3] m, rotations[N,3,3], scales[N,3] m, opacities[N], sh[N,K,3], weights[N,J].

    `normals` [N,3] are those of the surface on which the Gaussians hang: light falls on it, not on each of them.
    """

    means: Tensor
    rotations: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    weights: Tensor
    normals: Tensor


class Surfels(NamedTuple):
    """Flat Gaussians of a surface at the canonical pose, before they have a colour.

    means[N,3] m, rotations[N,3,3] whose third columns are outward normals, scales[N,3] m, weights[N,J].
    """

    means: Tensor
    rotations: Tensor
    scales: Tensor
    weights: Tensor


class Resting(NamedTuple):
    """The same person in the rest pose of the skeleton, from which every pose starts.

    means[N,3] m, axes[N,3,3] scaled axes as columns, opacities[N], sh[N,K,3], weights[N,J], rotations[N,3,3] from the
    canonical frame, in which colour is stored, `normals` [N,3] of the surface on which they hang.
    """

    means: Tensor
    axes: Tensor
    opacities: Tensor
    sh: Tensor
    weights: Tensor
    rotations: Tensor
    normals: Tensor


def bone_transforms(joints: Tensor, parents: list[int], global_orient: Tensor, body_pose: Tensor) -> Tensor:
    """Transforms [...,J,4,4] of each bone from the rest pose to (global_orient[...,3], body_pose[...,69]), axis-angle, metres."""
    rotations = matrix_from_rotvec(torch.cat([global_orient, body_pose], -1).unflatten(-1, (-1, 3)))
    return rest_relative_transforms(joints, rotations, parents)


def rest(person: Canonical, canonical_bones: Tensor) -> Resting:
    """Take the person back to the rest pose: `taken_back` by `canonical_bones`[J,4,4] (rest to canonical)."""
    means, rotations = taken_back(person.means, person.weights, canonical_bones)
    axes = products(rotations, person.rotations * person.scales[:, None, :])
    normals = turned(rotations, person.normals)
    return Resting(means, axes, person.opacities, person.sh, person.weights, rotations, normals)


def taken_back(means: Tensor, weights: Tensor, canonical_bones: Tensor) -> tuple[Tensor, Tensor]:
    """Where means[N,3] m with weights[N,J] are at rest, and rotations[N,3,3] from the canonical frame: the inverse of the blend
    of `canonical_bones`[J,4,4] (rest to canonical).

    HUGS blends products of bone transforms, which shrinks the hips by 23 % at half weights; with the inverse of the
    blend the untrained model is SMPL in every pose, up to the floor under its weights. The da-pose blends at most +-1 rad
    about z, so no blend has a determinant under 0.29.
    """
    blend = (weights @ canonical_bones[:, :3].flatten(1)).unflatten(1, (3, 4))
    rotations = _inverse(blend[..., :3])
    return turned(rotations, means - blend[..., 3]), rotations


def _inverse(matrices: Tensor) -> Tensor:
    a, b, c = matrices.unbind(-1)
    rows = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2)
    return rows / (a * rows[..., 0, :]).sum(-1)[..., None, None]


def pose(
    person: Resting, bones: Tensor, transl: Tensor, few: FewBones | None = None, stretch: Stretch | None = None
) -> Splats:
    """Move the person by `bones`[J,4,4] (rest to posed) and `transl`[3] m into the world; covariances follow.

    The blend B of a Gaussian is applied to its axes as it is, B Sigma B^T, never made a rotation (hard case 14-9). `few` are
    the person's weights without zeros, if there are such, for poses that want no gradient; cloth grows by `stretch`, if any.
    """
    means, blend = skin(person.means, person.weights if few is None or bones.requires_grad else few, bones)
    rotations = products(blend, person.rotations) if person.sh.shape[1] > 1 else None
    axes = products(blend, person.axes) if stretch is None else stretch.grown(means, blend)
    normals = turned(blend.detach(), person.normals)
    return Splats(means + transl, axes, person.opacities, person.sh, rotations, normals=normals)

"""The person: Gaussians in a canonical pose, decoded from a triplane, moved by learned skinning (HUGS section 3)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from stages.avatar.body.rotations import matrix_from_6d, matrix_from_quat, matrix_from_rotvec, rotation_z_to
from stages.avatar.body.skinning import skin
from stages.avatar.body.smpl import edge_lengths, rest_relative_transforms, subdivide, vertex_normals
from stages.avatar.effects.clothing import Clothing
from stages.avatar.model.decoders import TEMPERATURE, Decoders, OwnCorrections
from stages.avatar.model.triplane import Triplane
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import bases

MARGIN = 0.2  # of the body's size, on each side of the box of the triplane
START_OPACITY = 0.8  # an opaque body from the first step leaves the scene nothing to explain behind it
WEIGHT_FLOOR = 1e-4  # keeps skinning logits within 0.92 of each other, so that a joint at 0 can come back (E02)
DEFECT = 0.5  # sum of absolute differences; kitchen draft: 2 % go, the specks around him with them, +0.2 dB over white
OFFSET = 0.05  # metres; a usual thickness of clothes
SCALE_RANGE = 4.0  # a scale leaves its initial value by at most a factor e^4


class Canonical(NamedTuple):
    """The person at the da-pose: means[N,3] m, frames[N,3,3], scales[N,3] m, opacities[N], sh[N,K,3], weights[N,J]."""

    means: Tensor
    frames: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    weights: Tensor


class Resting(NamedTuple):
    """The same person in the rest pose of the skeleton, from which every pose starts.

    means[N,3] m, axes[N,3,3] scaled axes as columns, opacities[N], sh[N,K,3], weights[N,J], turns[N,3,3] from the
    canonical frame, in which colour is stored.
    """

    means: Tensor
    axes: Tensor
    opacities: Tensor
    sh: Tensor
    weights: Tensor
    turns: Tensor


def bone_transforms(joints: Tensor, parents: list[int], global_orient: Tensor, body_pose: Tensor) -> Tensor:
    """Transforms [J,4,4] of each bone from the rest pose to (global_orient[3], body_pose[69]), axis-angle, metres."""
    rotations = matrix_from_rotvec(torch.cat([global_orient, body_pose]).unflatten(-1, (-1, 3)))
    return rest_relative_transforms(joints, rotations, parents)


def rest(person: Canonical, canonical_bones: Tensor) -> Resting:
    """Take the person back to the rest pose: the inverse of the blend of `canonical_bones`[J,4,4] (rest to canonical).

    HUGS blends products of bone transforms, which shrinks the hips by 23 % at half weights; with the inverse of the
    blend the untrained model is exactly SMPL in every pose. The da-pose blends at most +-1 rad about z, so no blend
    has a determinant under 0.29.
    """
    blend = (person.weights @ canonical_bones[:, :3].flatten(1)).unflatten(1, (3, 4))
    turns = _inverse(blend[..., :3])
    means = (turns @ (person.means - blend[..., 3])[..., None])[..., 0]
    axes = turns @ (person.frames * person.scales[:, None, :])
    return Resting(means, axes, person.opacities, person.sh, person.weights, turns)


def _inverse(matrices: Tensor) -> Tensor:
    a, b, c = matrices.unbind(-1)
    rows = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2)
    return rows / (a * rows[..., 0, :]).sum(-1)[..., None, None]


def pose(person: Resting, bones: Tensor, transl: Tensor) -> Splats:
    """Move the person by `bones`[J,4,4] (rest to posed) and `transl`[3] m into the world; covariances follow.

    The blend B of a Gaussian is applied to its axes as it is, B Sigma B^T, never made a rotation (hard case 14-9).
    """
    means, blend = skin(person.means, person.weights, bones)
    turns = blend @ person.turns if person.sh.shape[1] > 1 else None
    return Splats(means + transl, blend @ person.axes, person.opacities, person.sh, turns)


class Baked(NamedTuple):
    """A trained person without any network: the Gaussians at rest and the skeleton, and how clothes leave the body."""

    resting: Resting
    joints: Tensor
    parents: list[int]
    antialias: bool = False
    clothing: Clothing | None = None


def load_avatar(arrays, device: str | torch.device = "cpu") -> Baked:
    """Tensors of an avatar's arrays (`formats.splats.Avatar` or anything with its fields), float32 on `device`."""

    def to(name: str) -> Tensor:
        return torch.as_tensor(getattr(arrays, name), dtype=torch.float32, device=device)

    sh = torch.cat([to("sh0")[:, None], to("shN")], 1)
    frames = matrix_from_quat(to("quats"))
    person = Canonical(to("means"), frames, to("scales"), to("opacities"), sh, to("lbs_weights"))
    joints, parents = to("joints"), [int(p) for p in arrays.parents]
    bones = bone_transforms(joints, parents, torch.zeros(3, device=device), to("canonical_pose"))
    clothing = None if arrays.clothes is None else Clothing.of(arrays.clothes).to(joints)
    return Baked(rest(person, bones), joints, parents, arrays.antialias, clothing)


def pose_avatar(avatar: Baked, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Splats:
    """The avatar in the world at one pose: global_orient[3], body_pose[69] axis-angle, transl[3] m. No network runs."""
    bones = bone_transforms(avatar.joints, avatar.parents, global_orient, body_pose)
    resting = avatar.resting if avatar.clothing is None else avatar.clothing(avatar.resting, body_pose)
    return pose(resting, bones, transl)._replace(antialias=avatar.antialias)


class HumanModel(nn.Module):
    """The trainable person: positions per Gaussian; all else = initial value + what the networks say + its own correction.

    Built from the body at the canonical pose: vertices[V,3] m, faces[T,3], weights[V,J]. Two of the paper's ablations:
    without `lbs_learning` the skinning weights stay as they began; without `triplane` there are no networks.
    """

    ROWS = (
        "frames",
        "log_sizes",
        "logits",
        "sh_starts",
        "skin_logits",
        "homes",
    )  # buffers with one row a Gaussian, besides `xyz`

    def __init__(
        self,
        vertices: Tensor,
        faces: Tensor,
        weights: Tensor,
        *,
        rounds: int,
        channels: int,
        resolution: int,
        sh_degree: int,
        generator: torch.Generator,
        lbs_learning: bool = True,
        triplane: bool = True,
    ):
        super().__init__()
        triangles, (points, skinning) = subdivide(faces, rounds, vertices, weights)
        self.coefficients, joints = bases(sh_degree), weights.shape[1] if lbs_learning else 0
        self.triplane = self.decoders = None
        if triplane:
            size = vertices.amax(0) - vertices.amin(0)
            pad = MARGIN * torch.maximum(size, size.max() * 0.25)
            self.triplane = Triplane(vertices.amin(0) - pad, vertices.amax(0) + pad, channels, resolution, generator)
            self.decoders = Decoders(self.triplane.width, sh_degree, joints, generator).to(vertices)
        self.own = OwnCorrections(len(points), sh_degree, joints, alone=not triplane).to(vertices)
        half = (0.5 * edge_lengths(points, triangles)).clamp_min(1e-4)
        self.xyz = nn.Parameter(points.clone())
        self.register_buffer("frames", rotation_z_to(vertex_normals(points, triangles)))
        self.register_buffer("log_sizes", torch.stack([half, half, 0.5 * half], 1).log())
        self.register_buffer("logits", torch.full_like(half, math.log(START_OPACITY / (1 - START_OPACITY))))
        self.register_buffer("sh_starts", torch.zeros_like(points))
        self.register_buffer("skin_logits", TEMPERATURE * (skinning + WEIGHT_FLOOR).log())
        self.register_buffer("homes", points.clone())  # where each Gaussian began, see `untaught`

    def __len__(self) -> int:
        return len(self.xyz)

    def rows(self) -> list[tuple[nn.Module, str]]:
        """The parameters with one row a Gaussian: the module that owns each, and its name there."""
        return [(self, "xyz"), *((self.own, name) for name in self.own())]

    def forward(self) -> tuple[Canonical, Tensor, Tensor]:
        """Decode all Gaussians: the canonical person, and two penalties.

        The first is the mean squared distance by which points left the triplane's box, the second the mean squared
        correction of scale (log), opacity (logit) and place (in units of OFFSET).
        """
        out = self.own()
        shared = self.decoders(self.triplane(self.xyz)) if self.triplane else {}
        out |= {name: said + out[name] if name in out else said for name, said in shared.items()}
        stray = self.triplane.outside(self.xyz) if self.triplane else self.xyz.new_zeros(())
        skin_logits = self.skin_logits + out["skin"] if "skin" in out else self.skin_logits
        identity = torch.tensor([1.0, 0, 0, 0, 1, 0]).to(self.xyz)
        said = out["scale"] / SCALE_RANGE
        scale = out["scale"] / torch.hypot(torch.ones_like(said), said)  # unlike tanh never flat
        person = Canonical(
            means=self.xyz + out["offset"],
            frames=self.frames @ matrix_from_6d(identity + out["turn"]),
            scales=(self.log_sizes + scale).exp(),
            opacities=torch.sigmoid(self.logits + out["opacity"]),
            sh=torch.cat([self.sh_starts[:, None] + out["sh"][:, :1], out["sh"][:, 1:]], 1),
            weights=torch.softmax(skin_logits / TEMPERATURE, 1),
        )
        place = (out["offset"] / OFFSET).square().sum(1)
        shy = scale.square().sum(1) + out["opacity"].square() + place
        return person, stray, shy.mean()

    def untaught(self) -> Canonical:
        """The canonical person as it began, without what networks and steps added: an answer where no frame has taught.

        There the networks speak to features that are still random, and Adam turns gradients of nothing into steps.
        """
        sh = torch.zeros(len(self), self.coefficients, 3).to(self.homes)
        sh[:, 0] = self.sh_starts
        weights = torch.softmax(self.skin_logits / TEMPERATURE, 1)
        opacities = torch.sigmoid(self.logits)
        return Canonical(self.homes, self.frames, self.log_sizes.exp(), opacities, sh, weights)

    def defectors(self, weights: Tensor) -> Tensor:
        """Which Gaussians [N] have learned `weights` [N,J] that are not the body's: in a new pose they fly off as specks."""
        return (weights - self.untaught().weights).abs().sum(1) > DEFECT

"""The SMPL body in plain torch: shape, joints, linear blend skinning (Loper et al. 2015, https://smpl.is.tue.mpg.de)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor, nn

from stages import records
from stages.avatar.body.rotations import constant, matrix_from_rotvec

DA_POSE = torch.zeros(69)
"""The canonical pose [69] rad: all at rest but the legs apart, left hip +1 and right hip -1 about z."""
DA_POSE[2], DA_POSE[5] = 1.0, -1.0


class Body(nn.Module):
    """Vertices and joints of an SMPL-format body from its shape and pose; metres, y up, all buffers, no parameters.

    Joints come from all vertices, also after `subset`.
    """

    v_template: Tensor
    shapedirs: Tensor
    posedirs: Tensor
    lbs_weights: Tensor
    joint_template: Tensor
    joint_dirs: Tensor

    def __init__(self, model: records.BodyModel, dtype: torch.dtype = torch.float32):
        super().__init__()
        f64 = {
            name: torch.as_tensor(getattr(model, name)).to(torch.float64)
            for name in ("v_template", "shapedirs", "posedirs", "J_regressor", "lbs_weights")
        }
        f64["joint_template"] = f64["J_regressor"] @ f64["v_template"]
        f64["joint_dirs"] = torch.einsum("jv,vcb->jcb", f64.pop("J_regressor"), f64["shapedirs"])
        if not f64["posedirs"].any():  # the free body has no pose correctives: skip 4.3 M multiplications a frame
            f64["posedirs"] = f64["posedirs"][..., :0]
        for name, value in f64.items():
            self.register_buffer(name, value.to(dtype).contiguous(), persistent=False)
        self.parents = [int(p) for p in model.parents]

    @classmethod
    def still(cls, vertices: Tensor, weights: Tensor, joints: Tensor, parents: list[int]) -> Body:
        """A body of one shape, which no `betas` change: vertices[V,3] m, weights[V,24], joints[24,3] m, parents[24]."""
        body = cls.__new__(cls)
        nn.Module.__init__(body)
        shapedirs, joint_dirs = vertices.new_zeros(len(vertices), 3, 10), joints.new_zeros(len(joints), 3, 10)
        posedirs = vertices.new_zeros(len(vertices), 3, 0)
        for name, value in (("v_template", vertices), ("shapedirs", shapedirs), ("posedirs", posedirs)):
            body.register_buffer(name, value, persistent=False)
        for name, value in (("lbs_weights", weights), ("joint_template", joints), ("joint_dirs", joint_dirs)):
            body.register_buffer(name, value, persistent=False)
        body.parents = parents
        return body

    def subset(self, vertices: Tensor) -> Body:
        """The same body with only `vertices` [M] (indices); its joints do not change."""
        part = Body.__new__(Body)
        nn.Module.__init__(part)
        for name, value in self.named_buffers():
            kept = value if name.startswith("joint_") else value[vertices]
            part.register_buffer(name, kept, persistent=False)
        part.parents = self.parents
        return part

    def rest(self, betas: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices [..., V, 3] and joints [..., 24, 3] in the T-pose for `betas` [..., 10]."""
        return self.v_template + torch.einsum("vcb,...b->...vc", self.shapedirs, betas), self.rest_joints(betas)

    def rest_joints(self, betas: Tensor) -> Tensor:
        """Joints [..., 24, 3] in the T-pose for `betas` [..., 10]."""
        return self.joint_template + torch.einsum("jcb,...b->...jc", self.joint_dirs, betas)

    def forward(self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> tuple[Tensor, Tensor]:
        """Posed vertices [F,V,3] and joints [F,24,3] in metres, pose correctives included.

        `betas` [10] or [F,10], `global_orient` [F,3] and `body_pose` [F,69] rad, `transl` [F,3] m.
        """
        vertices, joints = self.rest(betas)
        rotations = matrix_from_rotvec(torch.cat([global_orient, body_pose], -1).unflatten(-1, (24, 3)))
        transforms = rest_relative_transforms(joints, rotations, self.parents)
        if self.posedirs.shape[-1]:
            feature = (rotations[..., 1:, :, :] - torch.eye(3).to(rotations)).flatten(-3)
            vertices = vertices + torch.einsum("vcp,...p->...vc", self.posedirs, feature)
        blend = (self.lbs_weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
        posed = (blend[..., :3] @ vertices[..., None])[..., 0] + blend[..., 3]
        moved = (transforms[..., :3, :3] @ joints[..., None])[..., 0] + transforms[..., :3, 3]
        return posed + transl[..., None, :], moved + transl[..., None, :]


class Landmarks(nn.Module):
    """Points that are fixed sums of posed vertices, without skinning any vertex.

    Skinning is linear in the vertices: sum_v r_v sum_k w_vk A_k x_v = sum_k A_k (sum_v r_v w_vk x_v), and the brackets
    are linear in betas and pose correctives, so they are summed once. Equals `regressor @ vertices` of the full body.
    """

    template: Tensor
    shape: Tensor
    pose: Tensor
    mass: Tensor

    def __init__(self, body: Body, regressor: Tensor):
        """`regressor` [K,V] over all vertices of `body`."""
        super().__init__()
        self.body = body.subset(torch.zeros(0, dtype=torch.long))
        f64 = torch.float64
        share = torch.einsum("lv,vk->lkv", regressor.to(f64), body.lbs_weights.to(f64))
        dtype = body.v_template.dtype
        for name, dirs in (
            ("template", body.v_template[..., None]),
            ("shape", body.shapedirs),
            ("pose", body.posedirs),
        ):
            summed = torch.einsum("lkv,vcb->lkcb", share, dirs.to(f64))
            self.register_buffer(name, summed.to(dtype), persistent=False)
        self.register_buffer("mass", share.sum(-1).to(dtype), persistent=False)

    def forward(self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> tuple[Tensor, Tensor]:
        """Landmarks [F,K,3] and joints [F,24,3] in metres; arguments as for Body."""
        joints = self.body.rest_joints(betas)
        rotations = matrix_from_rotvec(torch.cat([global_orient, body_pose], -1).unflatten(-1, (24, 3)))
        points, moved = self.placed(
            betas, joints, rotations, rest_relative_transforms(joints, rotations, self.body.parents)
        )
        return points + self.mass.sum(-1, keepdim=True) * transl[..., None, :], moved + transl[..., None, :]

    def placed(self, betas: Tensor, joints: Tensor, rotations: Tensor, transforms: Tensor) -> tuple[Tensor, Tensor]:
        """As `forward` without `transl`, of a skeleton whose `transforms` are those of `rest_relative_transforms`."""
        sums = self.template[..., 0] + torch.einsum("lkcb,...b->...lkc", self.shape, betas)
        if self.pose.shape[-1]:
            feature = (rotations[..., 1:, :, :] - torch.eye(3).to(rotations)).flatten(-3)
            sums = sums + torch.einsum("lkcp,...p->...lkc", self.pose, feature)
        turn, shift = transforms[..., :3, :3], transforms[..., :3, 3]
        points = torch.einsum("...kij,...lkj->...li", turn, sums.expand(*turn.shape[:-3], *sums.shape[-3:]))
        return points + self.mass @ shift, (turn @ joints[..., None])[..., 0] + shift


def rest_relative_transforms(joints: Tensor, rotations: Tensor, parents: list[int]) -> Tensor:
    """Transforms A [...,24,4,4] that carry the rest pose to the posed body: x_posed = sum_k w_k A_k x_rest.

    `joints` [24,3] or [...,24,3] at rest, local `rotations` [...,24,3,3], root first. The root turns about the pelvis
    joint, which stays where it is.
    """
    count = len(parents)
    above, *further = _ancestors(tuple(parents), joints.device)
    joints = joints.expand(*rotations.shape[:-3], count, 3)
    origin = joints.new_zeros(()).expand(*joints.shape[:-2], 1, 3)  # what the root hangs from
    bones = joints - torch.cat([joints, origin], -2).index_select(-2, above[:count])
    still = torch.eye(4, dtype=joints.dtype, device=joints.device).expand(*joints.shape[:-2], 1, 4, 4)
    world = torch.cat([affine(rotations, bones), still], -3)
    for rows in (above, *further):  # a product of 1, 2, 4, 8 transforms with as many before it
        world = world.index_select(-3, rows) @ world
    turn, place = world[..., :count, :3, :3], world[..., :count, :3, 3]
    return affine(turn, place - (turn @ joints[..., None])[..., 0])


def affine(rotation: Tensor, translation: Tensor) -> Tensor:
    """Rotations [...,3,3] and translations [...,3] to 4x4 matrices."""
    top = torch.cat([rotation, translation[..., None]], -1)
    last = constant(top.dtype, top.device, 0, 0, 0, 1).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, last], -2)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals [V,3] by the area-weighted mean of the faces around; zero for a vertex in no face with area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = torch.zeros_like(vertices).index_add_(
        0, faces.flatten(), torch.linalg.cross(b - a, c - a).repeat_interleave(3, 0)
    )
    length = normals.norm(dim=-1, keepdim=True)
    return normals / torch.where(length == 0, 1.0, length)


@lru_cache(maxsize=8)
def _ancestors(parents: tuple[int, ...], device: torch.device) -> tuple[Tensor, ...]:
    """Of each joint the row of its parent, of the one 2, 4, 8 above it and so on while there is any; the row past all joints
    stands for none.
    """
    none = len(parents)
    rows = torch.tensor([*(parent if 0 <= parent != joint else none for joint, parent in enumerate(parents)), none])
    found: list[Tensor] = []
    while (rows < none).any() and len(found) < none:  # parents in a ring have no end
        found.append(rows.to(device))
        rows = rows[rows]
    return tuple(found) or (rows.to(device),)

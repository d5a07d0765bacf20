"""The body's mesh with the colours of the avatar's Gaussians, for programs that draw triangles."""

from __future__ import annotations

import numpy as np
import torch

from stages import records
from stages.avatar.body.skinning import heaviest
from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.splats.neighbours import nearest
from stages.avatar.splats.sh import sh_colors

AROUND = 12  # Gaussians that colour a vertex
NEAR = 0.005  # m: a Gaussian this far off counts half
SEEN = 0.3  # opacity from which one counts


def surface_of(model: records.BodyModel, rig: records.Rig) -> records.Mesh:
    """The body at the rig's betas in the T-pose, each vertex in the mean colour of the Gaussians around it.

    The mesh has the body model's own skinning; its pose correctives, if any, are left out, since bones cannot hold them.
    """
    vertices, _ = Body(model).rest(torch.as_tensor(rig.betas))
    faces = torch.as_tensor(np.asarray(model.faces, np.int64))
    bones, weights, _ = heaviest(np.asarray(model.lbs_weights, np.float64))
    normals = vertex_normals(vertices, faces)
    normals[~normals.any(1), 1] = 1  # a vertex in no triangle: nobody sees it, and files want unit normals
    return records.Mesh(
        vertices=vertices.numpy(),
        normals=normals.numpy(),
        faces=np.asarray(model.faces, np.int32),
        colors=_colours(vertices, rig),
        bones=bones,
        weights=weights,
    )


def _colours(vertices: torch.Tensor, rig: records.Rig) -> np.ndarray:
    """Colours [V,3] in 0..1; grey where the rig has no Gaussian that is seen."""
    seen = rig.opacities > SEEN
    if not seen.any():
        return np.full((len(vertices), 3), 0.5, np.float32)
    colours = sh_colors(torch.as_tensor(rig.sh0[seen])[:, None], None).clamp(0, 1)
    away, rows = nearest(torch.as_tensor(rig.means[seen]), vertices, AROUND)
    share = torch.as_tensor(rig.opacities[seen])[rows] / (away / NEAR).square().add(1)
    share = (share / share.sum(1, keepdim=True)).to(colours)
    return (share[..., None] * colours[rows]).sum(1).numpy()

"""A person as the free body has it, who stands at the origin in the da-pose, and cameras around it."""

import numpy as np
import torch

from stages.avatar.body.smpl import DA_POSE, Body
from stages.avatar.cameras.pinhole import look_at
from stages.avatar.model.human import HumanModel
from stages.formats.body_model import read_body_model
from stages.training.views import Person


def stand(frames: int) -> tuple[HumanModel, Person]:
    """The untrained person, a Gaussian a vertex, and where it stands in `frames` frames."""
    data = read_body_model(None)
    body, betas, still = Body(data), torch.zeros(10), torch.zeros(1, 3)
    vertices = body(betas, still, DA_POSE[None], still)[0][0]
    faces = torch.as_tensor(data.faces.astype(np.int64))
    sizes = {"rounds": 0, "channels": 2, "resolution": 8, "sh_degree": 0}
    human = HumanModel(vertices, faces, body.lbs_weights, **sizes, generator=torch.Generator().manual_seed(0))
    poses = (torch.zeros(frames, 3), DA_POSE.expand(frames, -1), torch.zeros(frames, 3))
    confidence, joints = torch.ones(frames), body.rest(betas)[1]
    return human, Person(*poses, confidence, joints, body.parents, DA_POSE, vertices, body.lbs_weights, faces)


def around(eyes: tuple[tuple[float, float, float], ...], focal: float, side: int) -> tuple[torch.Tensor, torch.Tensor]:
    """viewmats[V,4,4] and Ks[V,3,3] of square cameras at `eyes` (metres) that look at the origin."""
    up = np.array([0.0, 1, 0])
    viewmats = torch.tensor(np.stack([look_at(np.array(eye, float), np.zeros(3), up) for eye in eyes])).float()
    K = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    return viewmats, K.expand(len(eyes), 3, 3)

"""A person as the free body has it, who stands at the origin in the da-pose, and cameras around it."""

import numpy as np
import torch

from stages.avatar.body.smpl import DA_POSE, Body
from stages.avatar.cameras.pinhole import look_at
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import Canonical, bone_transforms, pose, rest
from stages.avatar.rasterize import Camera
from stages.formats.body_model import read_body_model
from stages.training.views import FittedBody, Views
from tests.made.learned import compose
from tests.made.skin import on_vertices

SIZE, STILL = 192, torch.zeros(3)
EYES = ((0, 0, 3), (3, 0, 0.5), (-3, 0, 0.5))
"""Three square cameras, m: `views`, `drawn` and `silhouettes` are theirs."""


def stand(frames: int) -> tuple[HumanModel, FittedBody]:
    """The untrained person, a Gaussian a vertex, and where it stands in `frames` frames."""
    data = read_body_model(None)
    body, betas, still = Body(data), torch.zeros(10), torch.zeros(1, 3)
    vertices = body(betas, still, DA_POSE[None], still)[0][0]
    faces = torch.as_tensor(data.faces.astype(np.int64))
    sizes = {"channels": 2, "resolution": 8}
    human = HumanModel(
        on_vertices(vertices, faces, body.lbs_weights), **sizes, generator=torch.Generator().manual_seed(0)
    )
    poses = (torch.zeros(frames, 3), DA_POSE.expand(frames, -1), torch.zeros(frames, 3))
    confidence, joints = torch.ones(frames), body.rest(betas)[1]
    return human, FittedBody(*poses, confidence, joints, body.parents, DA_POSE, vertices, body.lbs_weights, faces)


def around(eyes: tuple[tuple[float, float, float], ...], focal: float, side: int) -> tuple[torch.Tensor, torch.Tensor]:
    """viewmats[V,4,4] and Ks[V,3,3] of square cameras at `eyes` (metres) that look at the origin."""
    up = np.array([0.0, 1, 0])
    viewmats = torch.tensor(np.stack([look_at(np.array(eye, float), np.zeros(3), up) for eye in eyes])).float()
    K = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
    return viewmats, K.expand(len(eyes), 3, 3)


def stand_red() -> tuple[Canonical, FittedBody]:
    """A red person as the free body has it, opaque, and where it stands in three frames."""
    human, where = stand(len(EYES))
    red = torch.tensor([1.0, -1, -1]).expand(len(human), 1, 3)
    person = human.initial()
    person = person._replace(sh=red, opacities=torch.full_like(person.opacities, 0.99), scales=1.5 * person.scales)
    return person, where


def drawn(person: Canonical, where: FittedBody, frame: int, body_pose=DA_POSE):
    """What the camera of a frame sees of a canonical person in a pose [69]."""
    resting = rest(person, where.canonical_bones())
    splats = pose(resting, bone_transforms(where.joints, where.parents, STILL, body_pose), STILL)
    cameras = views(torch.zeros(len(EYES), SIZE, SIZE))
    return compose(splats, None, Camera(cameras.viewmats[frame], cameras.Ks[frame], SIZE, SIZE))[0]


def views(masks) -> Views:
    """Black pictures with masks [3,SIZE,SIZE] in 0..1."""
    return Views(torch.zeros(len(EYES), SIZE, SIZE, 3), (255 * masks).round().byte(), *around(EYES, 270.0, SIZE))


def silhouettes(person: Canonical, where: FittedBody, body_pose=DA_POSE) -> torch.Tensor:
    """How opaque a canonical person is [3,SIZE,SIZE] in a pose [69]."""
    return torch.stack([drawn(person, where, frame, body_pose).alpha for frame in range(len(EYES))])

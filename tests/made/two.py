"""A tiny clip of two ellipsoids before a wall, red and blue, who cross; the red one is nearer. And trainings of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import bone_transforms, pose, rest
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera, Gaussians, rasterize
from stages.avatar.splats.compose import draw_together
from stages.avatar.splats.gaussians import together
from stages.avatar.splats.sh import sh_from_rgb
from stages.training.step.fit import Fit
from stages.training.step.outlines import outlines
from stages.training.step.person import Starting
from stages.training.views import FittedBody, Views
from tests.made.skeleton import PARENTS
from tests.made.skin import on_vertices
from tests.made.training import FRAMES, HEIGHT, TRAIN, WIDTH, ellipsoid, settings

INKS = ((0.9, 0.1, 0.1), (0.1, 0.1, 0.9))
PLACES = ((0.5, -0.4), (-0.5, 0.4))  # m: x where each begins and ends on the other side, and depth


def make_two() -> tuple[Views, list[FittedBody], list[Tensor]]:
    """Views whose masks are of both, the two, and each one's own masks uint8[F,H,W]."""
    vertices, faces, weights = ellipsoid()
    viewmats = torch.eye(4).repeat(FRAMES, 1, 1)
    viewmats[:, 2, 3], viewmats[:, 0, 3] = 3, torch.linspace(-0.2, 0.2, FRAMES)
    Ks = torch.tensor([[50.0, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]]).repeat(FRAMES, 1, 1)
    still, joints = torch.zeros(FRAMES, 3), torch.zeros(24, 3)
    people, dressed, way = [], [], torch.linspace(1, -1, FRAMES)
    for (x, depth), ink in zip(PLACES, INKS):
        transl = torch.stack([x * way, 0 * way, 0 * way + depth], 1)
        body = still, torch.zeros(FRAMES, 69), transl, torch.ones(FRAMES), joints, PARENTS, torch.zeros(69)
        people.append(FittedBody(*body, vertices, weights, faces))
        human = model(people[-1], 0)
        human.sh_starts.copy_(sh_from_rgb(torch.tensor(ink).expand(len(human), 3)))
        canonical = human()[0]
        dressed.append(
            rest(canonical._replace(opacities=torch.ones_like(canonical.opacities)), torch.eye(4).expand(24, 4, 4))
        )
    wall, (images, masks, own) = make_wall(0), ([], [], ([], []))
    with torch.no_grad():
        for f in range(FRAMES):
            there = [
                pose(r, bone_transforms(joints, PARENTS, still[f], p.body_pose[f]), p.transl[f])
                for r, p in zip(dressed, people)
            ]
            camera = Camera(viewmats[f], Ks[f], WIDTH, HEIGHT)
            (drawn,) = draw_together([*there, wall.splats()], camera)
            images.append((drawn.image.clamp(0, 1) * 255).round().byte())
            both = together(there)
            assert both is not None
            number = torch.arange(len(both.means)) >= len(there[0].means)
            shares = torch.stack([~number, number, torch.ones_like(number)], 1).float()
            (seen,) = rasterize(Gaussians(both.means, both.axes, both.opacities, shares), camera)
            *each, every = (255 * seen.image).round().byte().unbind(2)
            masks.append(every)
            for mine, mask in zip(own, each):
                mine.append(mask)
    return Views(torch.stack(images), torch.stack(masks), viewmats, Ks), people, [torch.stack(one) for one in own]


def make_wall(seed: int) -> SceneModel:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(150, 3, generator=generator) * torch.tensor([4.0, 3, 0.2]) - torch.tensor([2, 1.5, -1])
    scene = SceneModel(points, torch.full((150, 3), 0.5), 1, 1.0)
    if seed == 0:
        scene.sh0.data = torch.randn(scene.sh0.shape, generator=generator)
        scene.logit_opacities.data[:] = 3
        scene.log_scales.data += 1
    return scene


def model(person: FittedBody, seed: int) -> HumanModel:
    generator = torch.Generator().manual_seed(seed)
    sizes = {"channels": 8, "resolution": 24}
    return HumanModel(on_vertices(person.vertices, person.faces, person.weights), **sizes, generator=generator)


def fit_of_two(
    clip: tuple[Views, list[FittedBody], list[Tensor]], steps: int = 40, order: Sequence[int] = (0, 1), **more
) -> Fit:
    """The training of both, in this order."""
    views, people, masks = clip
    seen = outlines(views, [masks[k] for k in order], [people[k] for k in order])
    starting = [Starting(people[k], model(people[k], 1 + k), outline) for k, outline in zip(order, seen, strict=True)]
    how = settings(steps, **{"exposure": False} | more)
    return Fit(views, TRAIN, starting, make_wall(1), *how, torch.Generator().manual_seed(3))

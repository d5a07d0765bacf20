"""A tiny clip of a striped ellipsoid before a wall, trainings of it, and how two trainings are compared."""

from __future__ import annotations

import copy
import io

import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.nn.functional import avg_pool2d

from stages.avatar.body.joints import HEAD
from stages.avatar.drawing.attach import FaceSkin
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import Resting, bone_transforms, pose, rest
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.training.settings import Params
from stages.training.step.fit import Fit
from stages.training.step.person import Starting
from stages.training.step.schedule import Options
from stages.training.step.transients import Transients
from stages.training.views import FittedBody, Poses, Views
from tests.made.clothes import dressed
from tests.made.learned import compose
from tests.made.skeleton import PARENTS
from tests.made.skin import on_vertices

WIDTH, HEIGHT, FRAMES = 48, 40, 6
TRAIN = [0, 1, 3, 4, 5]


def ellipsoid():
    mesh = trimesh.creation.icosphere(2, 0.4)
    vertices = torch.tensor(mesh.vertices * [0.6, 1.6, 0.5], dtype=torch.float32)
    weights = torch.zeros(len(vertices), 24)
    weights[:, 3] = torch.sigmoid(vertices[:, 1] / 0.05)
    weights[:, 0] = 1 - weights[:, 3]
    return vertices, torch.tensor(np.array(mesh.faces)).long(), weights


def models(seed: int = 1, **more):
    generator = torch.Generator().manual_seed(seed)
    sizes = {"channels": 8, "resolution": 24} | more
    human = HumanModel(on_vertices(*ellipsoid()), **sizes, generator=generator)
    wall = torch.rand(150, 3, generator=generator) * torch.tensor([4.0, 3, 0.2]) - torch.tensor([2, 1.5, -1])
    return human, SceneModel(wall, torch.full((150, 3), 0.5), 1, 1.0), generator


def make_clip():
    """A bending, striped ellipsoid before a speckled wall, and its true poses."""
    vertices, _, weights = ellipsoid()
    viewmats = torch.eye(4).repeat(FRAMES, 1, 1)
    viewmats[:, 2, 3] = 3
    viewmats[:, 0, 3] = torch.linspace(-0.4, 0.4, FRAMES)
    Ks = torch.tensor([[50.0, 0, WIDTH / 2], [0, 50, HEIGHT / 2], [0, 0, 1]]).repeat(FRAMES, 1, 1)
    body_pose = torch.zeros(FRAMES, 69)
    body_pose[:, 8] = torch.linspace(-0.5, 0.5, FRAMES)
    still, joints = torch.zeros(FRAMES, 3), torch.zeros(24, 3)
    confidence = torch.ones(FRAMES)
    person = FittedBody(
        still, body_pose, still, confidence, joints, PARENTS, torch.zeros(69), vertices, weights, ellipsoid()[1]
    )
    human, scene, generator = models(0)
    scene.sh0.data = torch.randn(scene.sh0.shape, generator=generator)
    scene.logit_opacities.data[:] = 3
    scene.log_scales.data += 1
    images, masks = [], []
    with torch.no_grad():
        canonical = human()[0]._replace(sh=torch.sin(8 * vertices)[:, None] * 1.5)
        resting = rest(canonical, bone_transforms(joints, PARENTS, torch.zeros(3), torch.zeros(69)))
        for f in range(FRAMES):
            splats = pose(resting, bone_transforms(joints, PARENTS, still[f], body_pose[f]), still[f])
            camera = Camera(viewmats[f], Ks[f], WIDTH, HEIGHT)
            (drawn,) = compose(splats, scene.splats(), camera)
            images.append((drawn.image.clamp(0, 1) * 255).round().byte())
            masks.append((compose(splats, None, camera)[0].alpha * 255).round().byte())
    return Views(torch.stack(images), torch.stack(masks), viewmats, Ks), person


def settings(steps: int, **more) -> tuple[Params, Options]:
    """Of a tiny training: two frames a decode, at most 300 and 260 Gaussians; `more` is of either."""
    of_clip = {name: more.pop(name) for name in Options._fields if name in more}
    params = {"views_per_decode": 2, "human_cap": 300, "scene_cap": 260} | more
    return Params(steps=steps, **params), Options(1.0, **{"growth_rounds": 4} | of_clip)


def fit_of(clip, steps: int = 40, scene: bool = True, **more) -> Fit:
    views, person = clip
    human, wall, generator = models()
    how = settings(steps, **{"exposure": True} | more)
    return Fit(views, TRAIN, [Starting(person, human)], wall if scene else None, *how, generator)


def posed(fit: Fit, resting: Resting, *pose: Tensor, frame: int | None = None) -> Splats:
    """The first person, at rest, in a pose [3], [69], [3]; clothes as they swing in a `frame`, or in that pose."""
    who = fit.performer(fit.people[0], resting, lambda _: Poses(*pose), swings=frame is not None)
    return fit.effects.lit(who.splats(frame or 0))


def run(fit: Fit, until: int) -> list[float]:
    return [sum(fit.advance().values()) for _ in range(until - fit.progress.step)]


def twin(fit: Fit) -> Fit:
    """A copy of a training between two decodes, which a test may change; its networks are decoded anew."""
    left: dict[int, Tensor | None] = {}
    for who in fit.people:
        assert who.leaves is None or not fit.networks_learn
        left |= {id(vars(who).get(name)): None for name in ("leaves", "shared", "decoded", "prior")}
        left[id(who.pull)] = who.pull.detach()
    return copy.deepcopy(fit, left)


def stored(fit: Fit) -> dict:
    """The state of a training, as it comes back from a file."""
    file = io.BytesIO()
    torch.save(fit.state(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def same(one: Fit, other: Fit) -> bool:
    """True if two trainings are in the same state to the last bit, moments and random numbers included."""

    def flat(tree) -> list:
        branches = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, (list, tuple)) else [tree]
        return [tree] if branches == [tree] else [leaf for branch in branches for leaf in flat(branch)]

    pairs = zip(flat(one.state()), flat(other.state()), strict=True)
    return all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in pairs)


def states(fit: Fit) -> dict[str, torch.Tensor]:
    """Copies of all tensors of a training's models, by name."""
    return {f"{n}.{k}": v.clone() for n, m in fit.modules().items() for k, v in m.state_dict().items()}


def with_face(person: FittedBody) -> FittedBody:
    """The ellipsoid, whose upper part is a head: the first of 52 shapes slides it aside, the second lifts it, the third slides the
    lower part.
    """
    shapes, up = torch.zeros(52, len(person.vertices), 3), torch.sigmoid(person.vertices[:, 1] / 0.05)
    shapes[0, :, 0], shapes[1, :, 1], shapes[2, :, 0] = 0.12 * up, 0.12 * up, 0.12 * (1 - up)
    weights = person.weights.clone()
    weights[:, HEAD] = weights[:, 3] = 0.5 * person.weights[:, 3]
    return person._replace(weights=weights, face=FaceSkin(person.vertices, shapes))


def everything(clip, steps: int = 24) -> Fit:
    """A training with a sky, antialiasing, clothes, a face and transients."""
    views, person = clip
    blurred = avg_pool2d(views.images.permute(0, 3, 1, 2).float(), 7, 1, 3, count_include_pad=False)
    views = views._replace(images=blurred.permute(0, 2, 3, 1).round().byte())  # of noise others know nothing
    person = with_face(dressed(person, TRAIN))
    generator = torch.Generator().manual_seed(1)
    skin, sizes = on_vertices(person.vertices, person.faces, person.weights), {"channels": 8, "resolution": 24}
    human = HumanModel(skin, person.cloth, **sizes, generator=generator)
    wall = torch.rand(150, 3, generator=generator) * torch.tensor([4.0, 3, 0.2]) - torch.tensor([2, 1.5, -1])
    scene = SceneModel(wall, torch.full((150, 3), 0.5), 3, 1.0, antialias=True)
    scene.add_sky(
        torch.tensor([[0.0, 0, 300], [5, 0, 300], [0, 5, 300]]),
        torch.rand(3, 3, generator=generator),
        torch.zeros(3),
        300.0,
    )
    how = settings(steps, exposure=True, antialias=True, learn_face=True)
    return Fit(views, TRAIN, [Starting(person, human)], scene, *how, generator, transients=Transients(views, TRAIN))

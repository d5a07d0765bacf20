"""Pictures from Python: what they show, and that their gradients are right."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import hugs
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import load_avatar
from stages.filming.clip_cast import completed
from stages.formats.body_model import read_body_model
from stages.formats.images import read_image
from stages.records import Effects
from tests.made import tiny
from tests.made.clothes import dress, some_clothes

VIEW = hugs.camera((0, 0, 0), (0, 0, 3), up=(0, -1, 0), focal=100, width=96, height=128)
STANDS = {"global_orient": (np.pi, 0, 0), "transl": (0, 0, 3)}


def as_drawn(record, dtype=torch.float32):
    """An avatar in a precision."""

    def to(part: Any) -> Any:
        if isinstance(part, torch.Tensor) and part.is_floating_point():
            return part.to(dtype)
        if isinstance(part, torch.nn.Module):
            return part.to(dtype)
        return type(part)(*map(to, part)) if isinstance(part, tuple) else part

    model = read_body_model()
    return hugs.Avatar(record, to(load_avatar(completed(record, model))), Body(model, dtype), model)


@pytest.fixture(scope="module")
def avatar():
    return as_drawn(tiny.make_avatar(read_body_model()))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hugs")
    return hugs.load_scene(tiny.make(folder)["train"] / "scene.npz")


def test_a_person_before_a_scene(avatar, scene, tmp_path):
    image, alpha, depth = hugs.draw(avatar.pose(**STANDS), VIEW, scene)
    shown = tiny.colour_of(np.rint(image * 255)) >= 0
    assert shown.sum() > 300 and alpha.min() > 0.8 and image.shape == (128, 96, 3)
    assert abs((depth / alpha)[shown].mean() - 3) < 0.2 < (depth / alpha)[~shown].mean() - 3.8
    hugs.write_image(str(tmp_path / "a.png"), image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), np.rint(np.clip(image, 0, 1) * 255))
    empty = hugs.draw(None, VIEW, scene).image
    assert isinstance(empty, torch.Tensor) and (tiny.colour_of(np.rint(empty.numpy() * 255)) >= 0).sum() == 0


def test_two_people_cover_each_other_before_a_background(avatar):
    near, far = (avatar.pose(**STANDS | {"transl": (x, 0, z)}) for x, z in ((0, 3), (0.5, 4)))
    both = hugs.draw([near, far], VIEW, background=(0.25, 0.5, 1))
    one, other = hugs.draw(near, VIEW), hugs.draw(far, VIEW)
    assert np.abs(both.image - one.image)[one.alpha > 0.995].max() < 0.02
    assert ((both.alpha > 0.9) & (one.alpha < 0.1)).sum() > 100 < ((one.alpha > 0.9) & (other.alpha > 0.9)).sum()
    np.testing.assert_allclose(both.image[both.alpha == 0], np.tile([0.25, 0.5, 1], (np.sum(both.alpha == 0), 1)))


def test_a_batch_is_each_picture_by_itself(avatar, scene):
    poses = avatar.pose(torch.zeros(3, 69), (np.pi, 0, 0), torch.tensor([[0, 0, 3], [0.1, 0, 3], [0.2, 0, 3.0]]))
    path = [VIEW, hugs.camera((0.3, 0, 0), (0, 0, 3), up=(0, -1, 0), width=96, height=128), VIEW]
    both, still = hugs.draw(poses, path, scene), hugs.draw(poses[0], path, scene)
    assert both.image.shape == (3, 128, 96, 3) and both.depth.shape == (3, 128, 96)
    for row in range(3):
        torch.testing.assert_close(both.image[row], hugs.draw(poses[row], path[row], scene).image, atol=1e-3, rtol=0)
        torch.testing.assert_close(still.image[row], hugs.draw(poses[0], path[row], scene).image)
    with pytest.raises(ValueError, match="cameras and poses differ"):
        hugs.draw(poses, path[:2])


def test_the_light_of_the_clip_shades_scene_and_person(avatar, scene):
    lamp = Effects(np.array([0.0, -0.6, -0.8]), 0.5, 0.04, 3.0, 0.6, shading=np.full((8, 3), 0.3))
    person = avatar.pose(**STANDS)
    lit, plain = hugs.draw(person, VIEW, scene, light=lamp), hugs.draw(person, VIEW, scene)
    behind, there = (hugs.draw(person, VIEW).alpha < 0.01), (hugs.draw(person, VIEW).alpha > 0.99)
    assert (lit.image - plain.image)[behind].min() < -0.05 and np.abs(lit.image - plain.image)[there].max() > 0.01


def test_what_is_not_finite_is_said_and_nothing_is_refused(avatar):
    broken = avatar.changed(means=avatar.rest.means.clone().index_fill_(0, torch.tensor([3, 5]), torch.nan))
    with pytest.warns(UserWarning, match="2 Gaussians"):
        assert np.isfinite(hugs.draw(broken.pose(**STANDS), VIEW).image).all()
    with pytest.raises(ValueError, match="neither a person nor a scene"):
        hugs.draw([], VIEW)


def measured(record, dtype):
    """A number that all of a picture counts in, as a function of everything that it is differentiable in."""
    avatar, view = as_drawn(record, dtype), VIEW._replace(width=48, height=64)
    rng = np.random.default_rng(4)
    body_pose = rng.normal(0, 0.3, 69)
    body_pose[6:30] = 0  # eight joints are not turned at all; at the hips clothes have a kink there
    shot = view.K * torch.tensor([[0.5, 1, 0.5], [1, 0.5, 0.5], [1, 1, 1]])
    turned = np.array([[1, 0, 0, 0.05], [0, -1, 0, 0.1], [0, 0, -1, 3], [0, 0, 0, 1]])
    start = {"body_pose": body_pose, "global_orient": np.zeros(3), "transl": rng.normal(0, 0.1, 3)}
    start |= {"betas": np.zeros(10), "viewmat": turned, "K": shot.numpy(), "background": np.array([0.2, 0.5, 0.7])}
    rest = avatar.rest
    start |= {name: getattr(rest, name).numpy() for name in ("means", "axes", "opacities", "sh")}
    weights = [torch.as_tensor(rng.normal(0, 1, shape)).to(dtype) for shape in ((64, 48, 3), (64, 48), (64, 48))]

    def of(given):
        parts = [given[name] for name in ("body_pose", "global_orient", "transl", "betas")]
        changed = avatar.changed(**{name: given[name] for name in ("means", "axes", "opacities", "sh")})
        camera = hugs.Camera(given["viewmat"], given["K"], 48, 64)
        drawn = hugs.draw(changed.pose(*parts), camera, background=given["background"])
        return sum((weight * part).sum() for weight, part in zip(weights, drawn))

    return of, {name: torch.as_tensor(part).to(dtype) for name, part in start.items()}


@pytest.fixture(scope="module")
def worn():
    """A small person in clothes whose colours depend on the direction."""
    record = dress(tiny.make_avatar(read_body_model(), every=60), some_clothes())
    noise = np.random.default_rng(1).normal(0, 0.02, (len(record), 3, 3))  # at black a colour has a slope of its own
    return replace(record, shN=noise, scales=1.5 * record.scales, opacities=0.7 * record.opacities)


def slopes(of, start):
    leaves = {name: part.clone().requires_grad_() for name, part in start.items()}
    of(leaves).backward()
    return {name: leaf.grad for name, leaf in leaves.items()}


@pytest.fixture(scope="module")
def true_slopes(worn):
    return slopes(*measured(worn, torch.float64))


@pytest.mark.slow
def test_gradients_are_finite_differences(worn, true_slopes, held):
    of, start = measured(worn, torch.float64)
    rng, step = np.random.default_rng(2), 1e-8  # small: a pixel that enters a Gaussian is a jump
    for name, value in start.items():
        way = torch.as_tensor(rng.normal(0, 1, value.shape))
        if name in ("viewmat", "K"):
            way[-1] = 0
        if name == "K":
            way[0, 1] = way[1, 0] = 0
        ahead, back = (float(of(start | {name: value + sign * step * way})) for sign in (1, -1))
        slope = float((true_slopes[name] * way).sum())
        held(abs((ahead - back) / (2 * step) - slope) / abs(slope), 1e-4, name)


@pytest.mark.slow
def test_the_fast_kernel_has_these_gradients_too(worn, true_slopes, held):
    for name, slope in slopes(*measured(worn, torch.float32)).items():
        apart = (slope.double() - true_slopes[name]).norm() / true_slopes[name].norm()
        held(apart, 1e-3, name)

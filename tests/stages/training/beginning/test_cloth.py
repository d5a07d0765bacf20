"""A person's cloth is found in the masks of frames, with bones of its own; a bare body stays as it is."""

import numpy as np
import pytest
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import pinhole
from stages.avatar.kernels.mesh import covered
from stages.avatar.model.human import HumanModel
from stages.formats.body_model import read_body_model
from stages.synthetic import person
from stages.synthetic.clip import camera_path
from stages.training.beginning.cloth import clothed
from stages.training.views import FittedBody, Views
from tests.made.skin import on_vertices
from tests.made.synthetic import cloth as moving
from tests.made.synthetic import wardrobe

FRAMES, WIDTH, HEIGHT = 24, 96, 128


@pytest.fixture(scope="module")
def filmed():
    """The masks of a bare body and of one in a skirt that turns before a camera: FittedBody and two Views."""
    model, rng = read_body_model(), np.random.default_rng(0)
    body, betas, faces = Body(model, dtype=torch.float64), np.zeros(10), np.asarray(model.faces, np.int64)
    orient, pose = person.make_motion(FRAMES, 8.0, rng)
    transl, vertices, _ = person.pose_body(body, betas, orient, pose)
    skirt = wardrobe.make_garments(["skirt"], model, betas, rng)[0]
    (worn,) = moving.worn([skirt.cloth], body, faces, betas, (orient, pose, transl), 8.0)
    viewmats, K = camera_path(FRAMES, 8.0, rng), pinhole(0.95 * HEIGHT, WIDTH, HEIGHT)
    both, all_faces = np.concatenate([vertices, worn], 1), np.concatenate([faces, skirt.faces + vertices.shape[1]])
    masks = [
        np.stack([covered(v, f, view, K, WIDTH, HEIGHT) for v, view in zip(points, viewmats)])
        for points, f in ((vertices, faces), (both, all_faces))
    ]
    rest, joints = body.rest(torch.zeros(10, dtype=torch.float64))
    parts = (torch.as_tensor(part).float() for part in (orient, pose, transl, np.ones(FRAMES), joints))
    still = (body.parents, torch.zeros(69), rest.float(), body.lbs_weights.float(), torch.as_tensor(faces))
    cameras = torch.as_tensor(viewmats).float(), torch.as_tensor(np.tile(K, (FRAMES, 1, 1))).float()
    views = [
        Views(torch.zeros(FRAMES, 1, 1, 3), torch.as_tensor(255 * mask.astype(np.uint8)), *cameras) for mask in masks
    ]
    return FittedBody(*parts, *still), *views, skirt.cloth.places


@pytest.fixture(scope="module")
def found(filmed) -> FittedBody:
    """The body with the skirt that its frames show."""
    bare, _, views, _ = filmed
    return clothed(bare, views, list(range(FRAMES)), 0.025)


@pytest.mark.slow
def test_a_skirt_is_found_where_it_is_with_bones_that_share_it(filmed, found):
    bare, _, _, places = filmed
    assert found.cloth is not None and 6 <= found.own_bones <= 24
    assert found.weights.shape[1] == found.cloth.weights.shape[1] == 24 + found.own_bones
    torch.testing.assert_close(found.cloth.weights.sum(1), torch.ones(len(found.cloth.means)))
    assert not found.weights[:, 24:].any() and torch.equal(found.weights[:, :24], bare.weights)
    low, high = places.min(0) - [0.05, 0.15, 0.05], places.max(0) + 0.05  # it hangs lower than it is cut
    inside = ((found.cloth.means.numpy() > low) & (found.cloth.means.numpy() < high)).all(1)
    assert inside.mean() > 0.97, "nothing at arms and head"
    between = found.cloth.means[(found.cloth.means[:, 0].abs() < 0.03) & (found.cloth.means[:, 2] > 0)]
    assert len(between) > 10, "it spans between the legs"
    assert found.cloth.weights[:, 24:].sum(1).mean() > 0.7
    points, normals, weights = found.surface()
    assert len(points) == len(normals) == len(weights) == len(bare.vertices) + len(found.cloth.means)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(points)))


@pytest.mark.slow
def test_its_gaussians_begin_there_and_the_first_picture_is_of_a_skirt(filmed, found):
    bare, *_ = filmed
    sizes = {"channels": 4, "resolution": 8}
    generator = torch.Generator().manual_seed(0)
    skin = on_vertices(found.vertices, found.faces, found.weights)
    human = HumanModel(skin, found.cloth, **sizes, generator=generator)
    canonical = human()[0]
    assert len(human) == len(bare.vertices) + len(found.cloth.means)
    torch.testing.assert_close(canonical.means[len(bare.vertices) :], found.cloth.means)
    torch.testing.assert_close(canonical.weights[len(bare.vertices) :], found.cloth.weights, atol=6e-3, rtol=0)


@pytest.mark.slow
def test_a_bare_body_has_no_cloth(filmed):
    bare, views, _, _ = filmed
    assert clothed(bare, views, list(range(FRAMES)), 0.025) is bare

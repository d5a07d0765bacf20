"""A face that training learns: each frame its own, few shapes, and nothing where frames show nothing."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from stages.avatar.model.person import bone_transforms, pose, rest
from stages.training.step.fit import Fit
from stages.training.step.person import Starting
from stages.training.step.refine import BodyCorrections
from tests.made import training
from tests.made.learned import compose
from tests.made.skeleton import PARENTS

SHOWN = torch.tensor([0.0, 0.9, 0.45, 0.0, 0.9, 0.2])
"""How far the first shape is open in the clip; frame 2 is held out."""


def talking(own: bool = False):
    """The clip of a striped ellipsoid, all of it a head, whose upper part slides aside by the first of 52 shapes, or of its `own`
    expressions, which then goes the other way.
    """
    views, person = training.make_clip()
    person = training.with_face(person)
    if own:
        slide, none = person.face.shapes[:1], torch.zeros_like(person.face.shapes)
        person = person._replace(face=person.face._replace(shapes=torch.cat([none, -slide, none[:9]])))
    person = person._replace(body_pose=torch.zeros_like(person.body_pose))
    human, scene, generator = training.models(0)
    scene.sh0.data = torch.randn(scene.sh0.shape, generator=generator)
    scene.logit_opacities.data[:] = 3
    images, masks = [], []
    with torch.no_grad():
        canonical = human()[0]._replace(sh=torch.sin(8 * person.vertices)[:, None] * 1.5, weights=person.weights)
        resting = rest(canonical, bone_transforms(person.joints, PARENTS, torch.zeros(3), torch.zeros(69)))
        mien = person.face.at(resting.means, resting.weights)
        towards = -F.one_hot(torch.tensor(52), 62) if own else F.one_hot(torch.tensor(0), 52)
        for f, shown in enumerate(SHOWN):
            open_wide = resting._replace(means=mien.moved(resting.means, shown * towards))
            splats = pose(open_wide, person.bones(f), person.transl[f])
            (drawn,) = compose(splats, scene.splats(), views.camera(f))
            images.append((drawn.image.clamp(0, 1) * 255).round().byte())
            masks.append((compose(splats, None, views.camera(f))[0].alpha * 255).round().byte())
    return views._replace(images=torch.stack(images), masks=torch.stack(masks)), person


def learned(steps: int, own: bool = False, **more) -> Fit:
    views, person = talking(own)
    human, wall, generator = training.models()
    how = training.settings(steps, **{"refine_pose": False, "learn_face": True} | more)
    fit = Fit(views, training.TRAIN, [Starting(person, human)], wall, *how, generator)
    training.run(fit, steps)
    return fit


def test_each_frame_learns_the_face_it_shows_and_one_that_is_held_out_takes_its_neighbours():
    found = learned(150)
    faces = found.poses(found.people[0]).face
    mouth, spread = faces[:, 0], faces[training.TRAIN].std(0)
    assert np.corrcoef(mouth[training.TRAIN], SHOWN[training.TRAIN])[0, 1] > 0.95, mouth
    assert mouth[[1, 4]].min() > 0.4 and spread[1:].max() < 0.4 * spread[0], faces[:, :4]
    torch.testing.assert_close(faces[2], faces[[1, 3]].mean(0))
    assert faces.min() >= 0 and faces.max() <= 1
    assert faces[:, 3:].max() == 0, "shapes that move nothing stay at 0"


@pytest.mark.slow
def test_a_bodys_own_expressions_are_learned_to_both_sides_and_shapes_of_zeros_stay_at_exactly_0():
    found = learned(150, own=True)
    faces = found.poses(found.people[0]).face
    assert faces.shape == (len(SHOWN), 62) and not faces[:, :52].any() and not faces[:, 53:].any()
    assert np.corrcoef(faces[training.TRAIN, 52], SHOWN[training.TRAIN])[0, 1] < -0.95, faces[:, 52]
    assert faces[[1, 4], 52].max() < -0.4
    pull = found.people[0].corrections.prior(1, training.TRAIN).detach()
    with torch.no_grad():
        found.people[0].corrections.face.weight[:, 52] *= -1
    torch.testing.assert_close(found.people[0].corrections.prior(1, training.TRAIN).detach(), pull)


def test_where_no_face_is_to_be_learned_none_is():
    found = learned(10, learn_face=False)
    assert found.poses(found.people[0]).face is None
    assert not found.people[0].corrections.face.weight.any()


def test_a_prior_pulls_shapes_to_0_and_frames_to_their_neighbours():
    found, train = BodyCorrections(6, face=54), [0, 1, 3, 4]
    with torch.no_grad():
        found.face.weight[:, 0] = torch.tensor([0.2, 0.8, 0.0, 0.4, 0.0, 0.0])
    (slope,) = torch.autograd.grad(found.prior(1, train), found.face.weight)
    slope = slope.coalesce()
    assert slope.indices().flatten().tolist() == [1]
    row = slope.values()[0]
    assert row[0] > row[1] > 0, "0.5 over its neighbours' mean; the others are alike there"
    found.clamp_face()
    with torch.no_grad():
        found.face.weight[0, [0, 1, 52, 53]] = torch.tensor([1.4, -0.3, 2.5, -2.5])
    found.clamp_face()
    assert found.face.weight[0, [0, 1, 51, 52, 53]].tolist() == [1, 0, 0, 2, -2]
    plain = BodyCorrections(6)
    assert plain.prior(1, train) == 0 and plain.face is None

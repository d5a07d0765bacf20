"""The lining under the person's surface: it closes holes in new poses, and does not show beside the person."""

import pytest
import torch

from stages.avatar.body.smpl import DA_POSE
from stages.avatar.model.person import Canonical
from stages.avatar.model.skin import even_skin
from stages.avatar.splats.neighbours import nearest
from stages.training.finishing import lining
from stages.training.finishing.lining import SIDE, UNDER, WIDE, add_lining
from stages.training.finishing.painted import count_pixels
from stages.training.views import FittedBody
from tests.made.standing import EYES, SIZE, drawn, silhouettes, stand_red, views

ARMS_UP = DA_POSE.clone().view(23, 3)
ARMS_UP[15, 2], ARMS_UP[16, 2] = 1.0, -1.0  # shoulders, far above the da-pose
EMPTY = views(torch.zeros(len(EYES), SIZE, SIZE))


@pytest.fixture(scope="module")
def standing() -> tuple[Canonical, FittedBody]:
    """A red person, opaque, 7 mm between Gaussians, and where it stands."""
    _, where = stand_red()
    skin = even_skin(where.vertices, where.faces, where.weights, 20_000)
    red = torch.tensor([1.0, -1, -1]).expand(len(skin.means), 1, 3)
    opacities, normals = torch.full_like(skin.means[:, 0], 0.99), skin.rotations[..., 2]
    return Canonical(skin.means, skin.rotations, skin.scales, opacities, red, skin.weights, normals), where


@pytest.fixture(scope="module")
def torn(standing):
    """The same with a green back, whole; with holes of 3 cm; and those with a lining."""
    person, where = standing
    back = person.normals[:, 2:] < 0
    person = person._replace(sh=torch.where(back[..., None], person.sh.flip(2), person.sh))
    trunk = person.means[person.weights[:, [0, 1, 2, 3, 6, 9]].sum(1) > 0.9]
    middles = trunk[torch.randperm(len(trunk), generator=torch.Generator().manual_seed(0))[:250]]
    left = Canonical(*(part[nearest(middles, person.means, 1)[0][:, 0] > 0.015] for part in person))
    return person, left, add_lining(left, where, views(silhouettes(person, where)), [0, 1, 2])


def test_nobody_is_seen_through_in_any_pose(standing, torn):
    _, where = standing
    for body_pose in (DA_POSE, ARMS_UP.flatten()):
        whole, open_, closed = (drawn(one, where, 0, body_pose).image for one in torn)
        seen = (open_ - whole).abs().amax(2) > 0.2
        assert seen.sum() > 40, "the holes are there"
        mended = (closed - whole).abs().amax(2)[seen] < 0.1
        assert mended.float().mean() > 0.75, "but at sides, where red and green are neighbours"


def test_the_lining_has_the_colour_of_the_skin_above_it(standing):
    person, where = standing
    kept = add_lining(person, where, views(silhouettes(person, where)), [0, 1, 2])
    assert torch.equal(kept.means[: len(person.means)], person.means), "the person's own rows stay as they are"
    inner = kept.sh[len(person.means) :]
    assert len(inner) > 3000 and torch.allclose(inner, person.sh[:1].expand_as(inner), atol=1e-6)


def test_what_is_seen_through_colours_no_lining(standing):
    person, where = standing
    faint = person._replace(opacities=torch.full_like(person.opacities, 0.4), sh=-person.sh)
    both = Canonical(*(torch.cat(pair) for pair in zip(person, faint, strict=True)))
    inner = add_lining(both, where, EMPTY, [0, 1, 2]).sh[len(both.means) :]
    assert len(inner) > 3000 and torch.allclose(inner, person.sh[:1].expand_as(inner), atol=1e-6)
    inner = add_lining(faint, where, EMPTY, [0, 1, 2]).sh[len(faint.means) :]
    assert len(inner) > 100, "where nobody is opaque, the most opaque do"
    assert torch.allclose(inner, faint.sh[:1].expand_as(inner), atol=1e-6)


def test_the_lining_never_shows_beside_the_masks(standing, torn):
    (_, where), (person, left, kept) = standing, torn
    out = silhouettes(person, where) < 0.05
    assert (silhouettes(kept, where)[out] - silhouettes(left, where)[out]).max() < 0.02
    arm = person.means[:, 0] > 0.3
    armless = silhouettes(Canonical(*(part[~arm] for part in person)), where)
    faint = person._replace(opacities=torch.where(arm, 0.15, person.opacities))
    inner = add_lining(faint, where, views(armless), [0, 1, 2]).means[len(person.means) :]
    assert len(inner) > 3000 and inner[:, 0].min() < -0.5 and inner[:, 0].max() < 0.45, "an arm that no mask has"


def test_the_lining_does_not_lie_before_the_person(monkeypatch):
    """Where a surface is coarse and dented, as a face that all frames see from the front."""
    person, where = stand_red()
    dent = (person.rotations[:, 2, 2] > 0.5) & (person.means[:, 1] > -0.1)
    deep = person._replace(means=person.means - torch.where(dent, 0.03, 0.0)[:, None] * torch.tensor([0.0, 0, 1]))

    def hidden() -> int:
        kept = add_lining(deep, where, views(silhouettes(deep, where)), [0])
        clear = count_pixels(kept, where, views(silhouettes(kept, where)), [0]).clear[len(person.means) :]
        return int((clear > 0.2).sum())

    assert dent.sum() > 300 and hidden() < 30
    monkeypatch.setattr(lining, "BEFORE", 2.0)
    assert hidden() > 100, "the test can fail"


def test_the_lining_lies_evenly_inside_and_less_deep_in_thin_parts(standing):
    person, where = standing
    lined = add_lining(person, where, EMPTY, [0, 1, 2])
    inner = Canonical(*(part[len(person.means) :] for part in lined))
    away, near = nearest(person.means, inner.means, 1)
    deep = ((person.means[near[:, 0]] - inner.means) * person.normals[near[:, 0]]).sum(1)
    assert deep.quantile(0.05) > 0 and 0.5 * UNDER < deep.median() < UNDER and away.max() < 2 * UNDER
    hands = person.weights[near[:, 0]][:, [22, 23]].sum(1) > 0.9
    assert hands.sum() > 40 and deep[hands].median() < 0.6 * deep.median()
    torch.testing.assert_close(inner.scales[:, 0].max(), torch.tensor(WIDE * SIDE))
    torch.testing.assert_close(inner.weights.sum(1), torch.ones(len(deep)))


def test_where_nothing_is_solid_there_is_no_lining(standing):
    person, where = standing
    gone = person._replace(opacities=torch.full_like(person.opacities, 0.05))
    assert add_lining(gone, where, EMPTY, [0, 1, 2]) is gone

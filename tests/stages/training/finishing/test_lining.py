"""The lining under skin and cloth: it closes holes in new poses, and does not show beside the person."""

import pytest
import torch

from stages.avatar.body.rotations import matrix_from_rotvec
from stages.avatar.body.smpl import DA_POSE, edge_lengths
from stages.avatar.model.person import Canonical, Surfels
from stages.avatar.splats.neighbours import nearest
from stages.training.finishing import lining
from stages.training.finishing.lining import OUT, UNDER_CLOTH, UNDER_SKIN, _gaps, _lining, add_lining
from stages.training.finishing.painted import count_pixels
from stages.training.step.losses import dilated
from stages.training.views import FittedBody
from tests.made.standing import EYES, SIZE, drawn, silhouettes, stand_red, views

ARMS_UP = DA_POSE.clone().view(23, 3)
ARMS_UP[15, 2], ARMS_UP[16, 2] = 1.0, -1.0  # shoulders, far above the da-pose


@pytest.fixture(scope="module")
def standing() -> tuple[Canonical, FittedBody]:
    """A red person, opaque, and where it stands."""
    return stand_red()


@pytest.fixture(scope="module")
def torn(standing):
    """The same with a hole on each side of the chest, and what is kept of it; and which rows the holes took."""
    person, where = standing
    hole = (person.means[:, 0].abs() > 0.02) & (person.means[:, 0].abs() < 0.11)
    hole &= where.weights[:, [3, 6, 9]].sum(1) > 0.5
    left = Canonical(*(part[~hole] for part in person))
    kept = add_lining(left, where, views(silhouettes(person, where)), [0, 1, 2])
    return left, kept, hole


def test_nobody_is_seen_through_in_any_pose(standing, torn):
    (person, where), (left, kept, hole) = standing, torn
    assert hole.sum() > 50 and len(left.means) < len(kept.means)
    for body_pose in (DA_POSE, ARMS_UP.flatten()):
        whole, open_, closed = (silhouettes(p, where, body_pose)[0] for p in (person, left, kept))
        seen = (whole > 0.98) & (open_ < 0.6)
        assert seen.sum() > 40, "the hole is there"
        assert closed[seen].quantile(0.02) > 0.9


def test_the_lining_has_the_colour_of_the_skin_above_it(standing, torn):
    (person, where), (left, kept, _) = standing, torn
    assert torch.equal(kept.means[: len(left.means)], left.means), "the person's own rows stay as they are"
    assert torch.allclose(kept.sh[len(left.means) :], person.sh[:1], atol=1e-6)
    image = drawn(kept, where, 0).image
    opaque = drawn(kept, where, 0).alpha > 0.98
    red = 0.5 + 0.28209479 * person.sh[0, 0]
    assert (image[opaque] - red).abs().max() < 0.03


def test_what_is_seen_through_colours_no_lining(standing):
    person, where = standing
    faint = person._replace(opacities=torch.full_like(person.opacities, 0.4), sh=-person.sh)
    both = Canonical(*(torch.cat(pair) for pair in zip(person, faint, strict=True)))
    inner, _ = _lining(both, where, torch.zeros(len(where.surface()[0]), dtype=torch.long))
    assert torch.allclose(inner.sh, person.sh[:1], atol=1e-6)
    inner, _ = _lining(faint, where, torch.zeros(len(where.surface()[0]), dtype=torch.long))
    assert torch.allclose(inner.sh, faint.sh[:1], atol=1e-6), "where nobody is opaque, the most opaque do"


def test_the_lining_never_shows_beside_the_masks(standing, torn):
    (person, where), (left, kept, _) = standing, torn
    masks = silhouettes(person, where)
    out = masks < 0.05
    assert (silhouettes(kept, where)[out] - silhouettes(left, where)[out]).max() < 0.02
    armless = Canonical(*(part[person.means[:, 0] < 0.3] for part in person))
    kept = add_lining(armless, where, views(silhouettes(armless, where)), [0, 1, 2])
    inner = kept.means[len(armless.means) :]
    assert len(inner) > 3000 and inner[:, 0].min() < -0.5 and inner[:, 0].max() < 0.4, "an arm that is not there"


@pytest.mark.slow
def test_what_shows_beside_a_thinner_person_goes_deeper(standing, monkeypatch):
    person, where = standing
    masks = torch.stack([-dilated(-mask, 0.012) for mask in silhouettes(person, where)])
    thin = person._replace(opacities=torch.full_like(person.opacities, 0.3))
    kept = add_lining(thin, where, views(masks), [0, 1, 2]).means[len(person.means) :]
    deep = nearest(where.vertices, kept, 1)[0] > 1.2 * UNDER_SKIN[0][0]
    monkeypatch.setattr(lining, "UNDER_SKIN", OUT * UNDER_SKIN[:1])
    without = add_lining(thin, where, views(masks), [0, 1, 2]).means[len(person.means) :]
    assert deep.sum() > 100 and len(kept) > 1.1 * len(without)


@pytest.mark.slow
def test_the_lining_does_not_lie_before_a_person_who_lies_deeper_than_the_body(standing, monkeypatch):
    """No frame tells how deep a face is that all look at from the front; its lining hid it, and hung before its nose."""
    person, where = standing
    dent = (person.rotations[:, 2, 2] > 0.5) & (person.means[:, 1] > -0.1)
    deep = person._replace(means=person.means - torch.where(dent, 0.03, 0.0)[:, None] * torch.tensor([0.0, 0, 1]))

    def hidden() -> int:
        kept = add_lining(deep, where, views(silhouettes(deep, where)), [0])
        clear = count_pixels(kept, where, views(silhouettes(kept, where)), [0]).clear[len(person.means) :]
        return int((clear > 0.2).sum())

    assert dent.sum() > 300 and hidden() < 30
    monkeypatch.setattr(lining, "BEFORE", 2.0)
    assert hidden() > 100, "the test can fail"


def test_the_lining_stays_inside_thin_parts(standing):
    person, where = standing
    inset = UNDER_SKIN[0][0]
    inner, rows = _lining(person, where, torch.zeros(len(where.vertices), dtype=torch.long))
    assert len(rows) == len(where.vertices)
    depth = (inner.means - where.vertices).norm(dim=1)
    assert depth.max() <= inset * 1.001 and (depth < 0.5 * inset).any(), "fingers are thinner than the inset"
    apart = torch.cdist(inner.means, where.vertices).amin(1)
    assert (apart > 0.6 * depth).all()


def test_a_lining_is_as_wide_as_the_gaps_between_vertices_each_way():
    """A grid that is three times as long as wide, tilted: a lining that is round would be a haze beside a calf."""
    x, y = (part.flatten() for part in torch.meshgrid(torch.arange(7.0), torch.arange(7.0), indexing="ij"))
    turn = matrix_from_rotvec(torch.tensor([0.4, -0.3, 0.2]))
    vertices = torch.stack([0.01 * x, 0.03 * y, 0 * x], 1) @ turn.T
    corner = torch.tensor([i for i in range(41) if i % 7 < 6])
    faces = torch.cat(
        [torch.stack([corner, corner + 1, corner + 8], 1), torch.stack([corner, corner + 8, corner + 7], 1)]
    )
    turns, gaps = _gaps(vertices, faces, turn[:, 2].expand(49, -1))
    torch.testing.assert_close(turns.mT @ turns, torch.eye(3).expand(49, -1, -1), atol=1e-5, rtol=0)
    assert torch.allclose(torch.linalg.det(turns), torch.ones(49), atol=1e-5)
    assert ((turns[:, :, 2] @ turn[:, 2]).abs() > 0.9999).all()
    middle = ((x > 0) & (x < 6) & (y > 0) & (y < 6)).nonzero()[:, 0]
    assert ((turns[middle, :, 0] @ turn[:, 1]).abs() > 0.95).all(), "the long gaps are along y"
    assert (gaps[middle, 1] < 0.5 * gaps[middle, 0]).all() and (
        gaps[:, 0] <= edge_lengths(vertices, faces) + 1e-7
    ).all()
    for scale in (1e-3, 100.0):
        again, lengths = _gaps(scale * vertices, faces, turn[:, 2].expand(49, -1))
        assert ((again[middle, :, 0] @ turn[:, 1]).abs() > 0.95).all(), "in eyelids of 10 um, too"
        torch.testing.assert_close(lengths / scale, gaps, rtol=1e-3, atol=0)
    _, flat = _gaps(vertices * torch.tensor([1.0, 0, 0]), faces, torch.tensor([0.0, 0, 1]).expand(49, -1))
    assert (flat > 0).all(), "edges that are all in line"
    alone, lone = _gaps(torch.zeros(1, 3), faces[:0], turn[:, 2][None])
    assert alone.isfinite().all() and (lone == 0).all(), "a vertex in no face"


def test_without_frames_that_show_the_person_there_is_a_whole_lining(standing):
    person, where = standing
    empty = views(torch.zeros(len(EYES), SIZE, SIZE))
    assert len(add_lining(person, where, empty, [0, 1, 2]).means) == len(person.means) + len(where.vertices)


def test_cloth_has_a_lining_of_its_own_where_there_is_any(standing):
    """Half of a sheet before the shins is sheer, as the hull over the opening of a coat."""
    person, where = standing
    across, down = torch.meshgrid(torch.linspace(-0.3, 0.3, 25), torch.linspace(-1.0, -0.5, 21), indexing="ij")
    means = torch.stack([across, down, torch.full_like(across, 0.4)], -1).flatten(0, 1)
    count, weights = len(means), where.weights[:1].expand(len(means), -1)
    sheet = Surfels(
        means, torch.eye(3).expand(count, 3, 3), torch.tensor([0.0125, 0.0125, 0.006]).expand(count, 3), weights
    )
    opaque = means[:, 0] > 0.01
    blue = torch.tensor([-1.0, -1, 1]).expand(count, 1, 3)
    worn = person._replace(
        **{
            name: torch.cat([getattr(person, name), part])
            for name, part in [
                *sheet._asdict().items(),
                ("opacities", torch.where(opaque, 0.9, 0.02)),
                ("sh", blue),
                ("normals", means),
            ]
            if name in person._fields
        }
    )
    empty = views(torch.zeros(len(EYES), SIZE, SIZE))
    kept = add_lining(worn, where._replace(cloth=sheet), empty, [0, 1, 2])
    added = kept.means[len(worn.means) + len(where.vertices) :]
    depth, wide = UNDER_CLOTH[0]
    assert len(added) == pytest.approx(opaque.sum().item(), abs=25), "a column more or less"
    torch.testing.assert_close(added[:, 2], torch.full_like(added[:, 2], 0.4 - depth))
    torch.testing.assert_close(kept.scales[-len(added) :, 0], torch.full_like(added[:, 0], wide * 0.0125))
    assert torch.equal(kept.sh[-len(added) :], blue[: len(added)]) and added[:, 0].min() > -0.03

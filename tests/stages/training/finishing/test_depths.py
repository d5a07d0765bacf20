"""Gaussians that stand out of the surface along a sight are put back, and pressed flat where no other sight holds them."""

import pytest
import torch

from stages.avatar.model.person import Canonical
from stages.avatar.splats.neighbours import nearest
from stages.training.finishing import depths
from stages.training.views import Views
from tests.made.standing import around, stand

SIZE = 96
EYES = ((0, 0, 3), (3, 0, 0), (0.3, 0, 3))  # before, beside, nearly before
OUT = 0.03


@pytest.fixture(scope="module")
def pushed():
    """A person, where it stands, the same with Gaussians of the front pushed to the eye and away, which, and sights."""
    human, where = stand(len(EYES))
    person = human.initial()
    sights = torch.nn.functional.normalize(torch.tensor(EYES[0]) - person.means, dim=1)
    thick = where.weights[:, [0, 1, 2, 3, 4, 5, 6, 9]].sum(1) > 0.9  # in a hand, either side may be meant
    front = (thick & ((person.rotations[..., 2] * sights).sum(1) > 0.8)).nonzero()[:, 0]
    chosen = front[torch.randperm(len(front), generator=torch.Generator().manual_seed(0))[:60]]
    sign = torch.where(torch.arange(60) % 2 == 0, 1.0, -1.0)[:, None]
    means = person.means.clone()
    means[chosen] += OUT * sign * sights[chosen]
    return person, where, person._replace(means=means), chosen, sights


def views() -> Views:
    masks = torch.full((len(EYES), SIZE, SIZE), 255, dtype=torch.uint8)
    return Views(torch.zeros(len(EYES), SIZE, SIZE, 3), masks, *around(EYES, 130.0, SIZE))


@pytest.mark.parametrize("frames", [[0], [0, 2]])
def test_what_stands_out_goes_back_along_the_sight(pushed, frames):
    person, where, off, chosen, sights = pushed
    even, counts = depths.snap_to_surface(off, where, views(), frames)
    left = (even.means - person.means)[chosen].norm(dim=1)
    assert left.quantile(0.9) < 0.5 * OUT and left.median() < 2 * depths.OUT
    assert 0.9 * len(chosen) <= counts["snapped"] <= 1.2 * len(chosen)
    shift = (even.means - off.means)[chosen]
    across = shift - (shift * sights[chosen]).sum(1, keepdim=True) * sights[chosen]
    assert across.norm(dim=1).max() < 0.12 * OUT, "to that eye nothing has moved"
    same = set(Canonical._fields) - {"means", "rotations", "scales"}
    assert all(getattr(even, name) is getattr(off, name) for name in same)


def test_seen_from_more_sides_a_step_stays_and_what_is_alone_goes_back(pushed):
    person, where, _, _, sights = pushed
    outwards = person.rotations[..., 2]
    front = ((outwards * sights).sum(1) > 0.8) & (where.weights[:, [0, 3, 6, 9]].sum(1) > 0.8)
    alone = front.nonzero()[::30, 0]
    steps = nearest(person.means, person.means[alone], depths.LEVEL + 2)[1]  # fewer than half of those around
    for rows, left in ((alone, depths.TOLD), (steps.flatten(), OUT)):
        means = person.means.clone()
        means[rows] = person.means[rows] + OUT * outwards[rows]
        even, _ = depths.snap_to_surface(person._replace(means=means), where, views(), [0, 1, 2])
        height = ((even.means - person.means)[alone] * outwards[alone]).sum(1)
        assert height.median() == pytest.approx(left, abs=0.1 * OUT)


def across(person: Canonical, lines: torch.Tensor) -> torch.Tensor:
    """Sigma [N] along each of the lines [N,3]."""
    return ((lines[:, None] @ person.rotations)[:, 0] * person.scales).norm(dim=1)


@pytest.mark.parametrize(("frames", "flat"), [([0], True), ([0, 1], False)])
def test_what_is_seen_from_one_side_is_pressed_flat_and_stays_as_wide(pushed, frames, flat):
    person, where, _, chosen, _ = pushed
    normals, thick = person.rotations[chosen][..., 2], 4 * depths.FLAT
    scales, rotations = person.scales.clone(), person.rotations.clone()
    scales[chosen] = torch.tensor([thick, 0.5 * depths.FLAT, thick])
    tilt = torch.tensor([[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]])  # no axis lies along the skin's normal
    rotations[chosen] = rotations[chosen] @ tilt
    even, counts = depths.snap_to_surface(person._replace(scales=scales, rotations=rotations), where, views(), frames)
    assert (counts["flattened"] >= len(chosen)) == flat
    before, now = (person._replace(scales=scales, rotations=rotations), even)
    before, now = (Canonical(*(part[chosen] for part in one)) for one in (before, now))
    sigma = across(now, normals).median()
    assert sigma == pytest.approx(depths.FLAT if flat else thick, rel=0.1)
    for axis in (0, 1):  # of the skin
        line = person.rotations[chosen][..., axis]
        assert (across(now, line) / across(before, line)).median() == pytest.approx(1, abs=0.05)
    assert torch.linalg.det(even.rotations).min() > 0.99 and even.scales.min() > 0


def test_what_is_seen_edge_on_stays_but_for_dots_far_out(pushed):
    person, where, *_ = pushed
    flank = ((person.rotations[:, 2, 2].abs() < 0.3) & (where.weights[:, [0, 1, 2, 3]].sum(1) > 0.9)).nonzero()[::20, 0]
    outwards = person.rotations[flank][..., 2]
    for out, left in ((0.5 * depths.OUT, 0.5 * depths.OUT), (OUT, depths.OUT), (-OUT, -OUT)):
        means = person.means.clone()
        means[flank] += out * outwards
        even, _ = depths.snap_to_surface(person._replace(means=means), where, views(), [0])
        height = ((even.means - person.means)[flank] * outwards).sum(1)
        assert (height - left).abs().max() < 0.13 * OUT, "as even as the skin is"


def test_where_nobody_looks_nothing_moves(pushed):
    _, where, off, *_ = pushed
    for cameras, frames in ((views(), []), (views()._replace(masks=torch.zeros(3, SIZE, SIZE)), [0, 1, 2])):
        even, counts = depths.snap_to_surface(off, where, cameras, frames)
        assert not counts["snapped"] and not counts["flattened"] and torch.equal(even.means, off.means)


def test_an_even_person_stays_even_when_evened_again(pushed):
    _, where, off, *_ = pushed
    once, _ = depths.snap_to_surface(off, where, views(), [0])
    again, _ = depths.snap_to_surface(once, where, views(), [0])
    assert (once.means - off.means).norm(dim=1).max() > 0.7 * OUT
    assert (again.means - once.means).norm(dim=1).max() < 0.1 * OUT

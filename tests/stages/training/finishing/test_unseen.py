"""What no frame shows has the pattern at the same height of the same limb, in the light beside it; a scalp that of scalps."""

import pytest
import torch

from stages.avatar.body.joints import ELBOWS, HEAD, KNEES, NECK, SHOULDERS
from stages.avatar.body.rotations import rotation_z_to
from stages.avatar.model.person import Canonical
from stages.avatar.splats.neighbours import median_near
from stages.training.finishing import bake, unseen
from stages.training.finishing.unseen import OnBody, continued, on_body, unseen_colors
from stages.training.views import FittedBody
from tests.made.standing import silhouettes, stand_red, views

RED, BLUE = torch.tensor([1.0, -1, -1]), torch.tensor([-1.0, -1, 1])


@pytest.fixture(scope="module")
def standing() -> tuple[Canonical, FittedBody]:
    """A red person of 20,000 Gaussians, by chance but as dense everywhere, and where it stands."""
    person, where = stand_red()
    generator = torch.Generator().manual_seed(0)
    corners = where.vertices[where.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face = torch.multinomial(normals.norm(dim=1), 20_000, replacement=True, generator=generator)
    share = torch.rand(len(face), 3, generator=generator).log()
    share = share / share.sum(1, keepdim=True)
    rows = where.faces[face]
    means, weights = (torch.einsum("fc,fcx->fx", share, of[rows]) for of in (where.vertices, where.weights))
    scales, rows = torch.tensor([0.008, 0.008, 0.002]).expand(len(face), 3), rows[:, 0]
    rest = person.opacities[rows], person.sh[rows], weights, normals[face]
    return Canonical(means, rotation_z_to(normals[face]), scales, *rest), where


@pytest.fixture(scope="module")
def limbs(standing) -> OnBody:
    return on_body(*standing)


def painted(person: Canonical, colors: torch.Tensor) -> Canonical:
    return person._replace(sh=colors[:, None].clone())


def guessed(person: Canonical, where: FittedBody, hidden: torch.Tensor) -> torch.Tensor:
    """Colours [H,3] of what is `hidden` [N], where all else is seen."""
    black = painted(person, torch.where(hidden[:, None], 0.0, person.sh[:, 0]))
    around, _ = median_near(black.sh[~hidden], black.means[~hidden], black.means, 24)
    return unseen_colors(black, on_body(person, where), around, ~hidden, hidden)[:, 0]


def test_limbs_begin_at_a_joint_and_go_to_the_next(standing, limbs):
    person, _ = standing
    limb, along = limbs
    trunk = limb == 0
    assert (
        set(limb.unique().tolist()) <= {*range(24)} and trunk[person.weights[:, [3, 6, 9, 13, 14]].sum(1) > 0.9].all()
    )
    for joint, least, most in ((SHOULDERS[0], 0.2, 0.35), (ELBOWS[0], 0.2, 0.35), (KNEES[1], 0.3, 0.5)):
        there = along[limb == joint]
        assert -0.08 < there.min() < 0.06 and least < there.max() < most, "m from its own joint to the next"
    assert torch.equal(along[trunk], person.means[trunk, 1])


def test_a_scalp_goes_from_the_forehead_down_the_back_of_the_head(standing, limbs):
    person, _ = standing
    limb, along = limbs
    head = person.means[person.weights.argmax(1) == HEAD]
    scalp, face = person.means[limb == HEAD], person.means[limb == NECK]
    assert (along[limb == HEAD] == 0).all() and len(scalp) > 200 and len(scalp) < len(face)
    low, high = head[:, 1].min(), head[:, 1].max()
    back, front = scalp[scalp[:, 2] < scalp[:, 2].median()], scalp[scalp[:, 2] > head[:, 2].max() - 0.05]
    assert back[:, 1].min() < low + 0.4 * (high - low) and front[:, 1].min() > low + 0.65 * (high - low)
    nose = face[face[:, 2].argmax()]
    assert nose[2] > head[:, 2].max() - 1e-4, "the foremost of the head is of the face"
    assert OnBody(torch.tensor([HEAD, NECK, 0, 5]), torch.zeros(4)).part.tolist() == [2, 1, 0, 0]


def test_stripes_and_hems_go_around_and_a_logo_does_not(standing, limbs):
    person, where = standing
    height = person.means[:, 1]
    trunk, back = limbs[0] == 0, person.rotations[:, 2, 2] < 0
    blue = (height / 0.16).round() % 2 == 0
    colors = torch.where(blue[:, None], BLUE, RED)
    logo = trunk & ~back & (person.means[:, 0].abs() < 0.04) & (height > -0.1) & (height < 0.15)
    assert logo.sum() > 30
    hidden = trunk & back
    found = guessed(painted(person, torch.where(logo[:, None], 3.0, colors)), where, hidden)
    edge = ((height / 0.16 - 0.5) % 1)[hidden]
    clear = (edge > 0.2) & (edge < 0.8)  # 3 cm from where a stripe ends
    off = (found - colors[hidden]).abs().amax(1)[clear]
    assert clear.sum() > 200 and off.median() < 0.3 and (off > 1).float().mean() < 0.15
    level = (height[hidden][clear] > -0.08) & (height[hidden][clear] < 0.13)
    assert level.sum() > 200 and off[level].median() < 0.1, "behind the logo, too"


def test_a_trunk_does_not_take_the_colours_of_arms_at_its_height(standing, limbs):
    person, where = standing
    colors = torch.where((limbs[0] == 0)[:, None], RED, BLUE)
    hidden = person.rotations[:, 2, 2] < 0
    off = (guessed(painted(person, colors), where, hidden) - colors[hidden]).abs().amax(1)
    assert (off > 1).float().mean() < 0.03


def test_the_light_beside_goes_on_over_a_back(standing, limbs, monkeypatch):
    """The left of the clip's person is in the sun: no seam where the right begins."""
    person, where = standing
    trunk, left = limbs[0] == 0, person.means[:, 0]
    colors = RED + 3 * left[:, None]
    hidden = trunk & (person.rotations[:, 2, 2] < 0.2)
    beside = left[hidden].abs() > 0.08

    def found() -> torch.Tensor:
        return guessed(painted(person, colors), where, hidden)[:, 0] - RED[0]

    lit = found()
    assert (lit[beside].sign() == left[hidden][beside].sign()).float().mean() > 0.9
    middle = left[hidden].abs() < 0.02
    assert lit[middle].abs().mean() < 0.1 and lit[beside].abs().mean() > 0.12
    monkeypatch.setattr(unseen, "continued", lambda values, near, hidden, part: 0)
    assert found()[beside].abs().mean() < 0.1, "the test can fail"


def test_the_back_of_a_head_is_scalp_and_not_face(standing, limbs, monkeypatch):
    person, where = standing
    limb, _ = limbs
    hair = limb == HEAD
    colors = torch.where(hair[:, None], BLUE, RED)
    hidden = torch.isin(limb, torch.tensor([HEAD, NECK])) & (person.rotations[:, 2, 2] < 0.1)
    assert (hidden & hair).sum() > 50 and (~hidden & hair).sum() > 50

    def off() -> torch.Tensor:
        return (guessed(painted(person, colors), where, hidden) - colors[hidden]).abs().amax(1)

    assert off()[hair[hidden]].mean() < 0.2 and off().mean() < 0.4
    monkeypatch.setattr(unseen, "SCALP", (9.0, 0.0))
    assert off()[hair[hidden]].mean() > 0.6, "the test can fail"


def test_a_limb_of_which_nothing_is_seen_takes_what_is_around(standing, limbs):
    person, where = standing
    hidden = limbs[0] == ELBOWS[0]
    found = guessed(person, where, hidden)
    assert hidden.sum() > 100 and (found - RED).abs().max() < 1.0 and found.isfinite().all()
    everything = torch.ones_like(hidden)
    everything[:3] = False  # hardly anything is seen
    assert guessed(person, where, everything).isfinite().all()


def test_what_takes_what_is_around_is_not_lit_twice(standing, limbs):
    """An arm that no frame shows beside a trunk whose left is in the sun."""
    person, where = standing
    arm = torch.isin(limbs[0], torch.tensor([SHOULDERS[0], ELBOWS[0], 20, 22]))
    colors = torch.where(((limbs[0] == 0) & (person.means[:, 0] > 0))[:, None], 0.6, 0.0).expand(-1, 3)
    found = guessed(painted(person, colors), where, arm)
    assert found.min() >= 0 and found.max() < 0.61, "as light as what is seen, no lighter"


def test_few_that_are_seen_of_a_hand_are_not_outvoted_by_what_is_no_hand(standing, limbs):
    person, where = standing
    hand = limbs[0] == 22
    rows = hand.nonzero()[:, 0]
    colors = torch.where(hand[:, None], RED, BLUE)
    for seen in (20, 40, 60):
        hidden = hand.clone()
        hidden[rows[torch.linspace(0, len(rows) - 1, seen).long()]] = False
        found = guessed(painted(person, colors), where, hidden)
        assert (found - RED).abs().amax(1).median() < 0.1


def test_cloth_on_many_bones_of_clothes_is_cloth(standing):
    person, where = standing
    spread = torch.cat([0.4 * person.weights, torch.full((len(person.means), 6), 0.1)], 1)
    limb, along = on_body(person._replace(weights=spread), where)
    assert (limb == len(where.joints)).all() and torch.equal(along, person.means[:, 1])


def test_what_goes_on_is_even_and_stops_at_another_part(held):
    x, y = (part.flatten() for part in torch.meshgrid(torch.arange(9.0), torch.arange(9.0), indexing="ij"))
    hidden = (x > 0) & (x < 8) & (y > 0) & (y < 8)
    at = torch.stack([x, y], 1)
    near = torch.cdist(at[hidden], at).topk(5, largest=False).indices[:, 1:]
    part = torch.zeros(81, dtype=torch.long)
    values = torch.stack([x - 2 * y, 3 + x], 1)
    found = continued(torch.where(hidden[:, None], 0.0, values), near, hidden, part)
    held(((found - values[hidden]) / 8).abs().max(), 5e-3, "what is linear around is linear within")
    one = (x > 4).long()
    split = continued(torch.where(hidden, 0.0, one.float())[:, None], near, hidden, one)[:, 0]
    assert (split - one[hidden]).abs().max() < 0.15
    mixed = continued(torch.where(hidden, 0.0, one.float())[:, None], near, hidden, part)[:, 0]
    assert (mixed - one[hidden]).abs().max() > 0.3


def test_a_front_view_alone_gives_hair_behind(standing, limbs):
    """Through `recolor`: what one camera sees decides what is hidden; the nearest that it sees of a nape is a face."""
    person, where = standing
    colors = torch.where((limbs[0] == HEAD)[:, None], BLUE, RED)
    learned = painted(person, torch.where((person.rotations[:, 2, 2] < 0)[:, None], 3.0, colors))  # noise behind
    found, (own, _, _) = bake.recolor(learned, where, views(silhouettes(person, where)), [0])
    off = (found.sh[:, 0] - colors).abs().amax(1)
    back = person.rotations[:, 2, 2] < -0.5
    for there in (limbs[0] == 0, limbs[0] == HEAD):
        assert own[there & back].max() < 0.1 and off[there & back].mean() < 0.2

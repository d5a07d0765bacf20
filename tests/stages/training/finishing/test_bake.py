"""What is kept of a person: unseen rows as the body says, colours that lean on sure ones."""

import pytest
import torch

from stages.avatar.effects.clothing import Clothing, Hung
from stages.avatar.model.person import Canonical, Surfels, rest
from stages.avatar.rasterize import Camera
from stages.avatar.splats.compose import painted_pixels
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import nearest
from stages.training.finishing import bake, painted
from stages.training.finishing.painted import count_pixels
from stages.training.views import FittedBody, Views, person_frames
from tests.made.learned import compose
from tests.made.standing import EYES, SIZE, drawn, silhouettes, stand_red, views


@pytest.fixture(scope="module")
def standing() -> tuple[Canonical, FittedBody]:
    """A red person, opaque, and where it stands."""
    return stand_red()


@pytest.mark.slow
def test_cloth_is_kept_with_as_many_bones_as_gltf_carries_and_skin_with_all(standing):
    person, where = standing
    seen = (views(silhouettes(person, where)), [0, 1, 2])
    few, everywhere = where.weights, torch.full_like(where.weights, 1 / 24)
    person = person._replace(weights=0.9 * few + 0.1 * everywhere)
    bare = bake.finish(person, person, where, *seen).person.weights
    assert (bare > 0).sum(1).max() == 24
    hung = Hung(torch.tensor([[0.2, -0.6, 0.1], [-0.2, -0.6, 0.1]]), everywhere[:2])
    pad = torch.nn.functional.pad
    clothed = where._replace(clothing=Clothing.start(hung, where.joints, where.body_pose), weights=pad(few, (0, 2)))
    worn = person._replace(weights=torch.cat([0.5 * person.weights, torch.full((len(few), 2), 0.25)], 1))
    kept = bake.finish(worn, worn, clothed, *seen).person.weights
    assert (kept > 0).sum(1).max() == 8 and (kept[: len(few), 24:] > 0.25).any()
    torch.testing.assert_close(kept.sum(1), torch.ones(len(kept)))


def test_colours_of_the_outline_lean_on_sure_ones_and_those_stay(standing):
    person, where = standing
    cameras = views(silhouettes(person, where))
    inside, edge, beside, *_, pixels = count_pixels(person, where, cameras, [0, 1, 2])
    assert torch.stack([inside, edge, beside]).min() >= 0 and (inside + edge).sum().item() > 0.9 * pixels
    flank = inside < 0.3 * edge
    front = (inside > bake.SURE * inside.mean()) & (inside > 20 * edge)
    assert flank.sum() > 300 and front.sum() > 300
    speckled = person._replace(sh=torch.where(flank[:, None, None], 2.0, person.sh))
    off = lambda p: (p.sh - person.sh).abs().amax((1, 2))  # noqa: E731
    out, (own, told, _) = bake.recolor(speckled, where, cameras, [0, 1, 2])
    assert ((told >= 0) & (told <= own[:, None])).all() and told[front].mean() > 0.4
    assert flank.sum() / 2 < (own < 0.5).sum() < len(person.means) and own[front].min() > 0.8
    assert off(out)[flank].mean() < 0.3 * off(speckled)[flank].mean() and off(out)[front].max() < 0.1
    assert all(a is b for name, a, b in zip(person._fields, out, speckled, strict=True) if name != "sh")
    empty = views(torch.zeros(len(EYES), SIZE, SIZE))
    out, (own, told, aslant) = bake.recolor(speckled, where, empty, [0, 1, 2])
    assert out is speckled and (own == 1).all() and (told == 0).all() and (aslant == 1).all(), (
        "nobody is sure of anything"
    )


def test_frames_tell_what_lies_across_the_view(standing):
    """One camera sees the chest from the front: how thick it is, and where it is along the view, nobody knows."""
    person, where = standing
    cameras = views(silhouettes(person, where))
    painted = count_pixels(person, where, cameras, [0])
    shown = painted.inside + painted.edge > 1
    sight = torch.nn.functional.normalize(person.means - torch.tensor([0.0, 0, 3]), dim=1)[shown]
    along = (person.rotations.mT[shown] @ sight[..., None])[..., 0].square()
    assert shown.sum() > 300
    torch.testing.assert_close(painted.along[shown], along, atol=1e-4, rtol=0)
    torch.testing.assert_close(painted.along[shown].sum(1), torch.ones(int(shown.sum())))
    cosines = (person.rotations[shown, :, 2] * sight).sum(1)
    torch.testing.assert_close(painted.straight[shown], painted.inside[shown] * cosines.square(), atol=1e-3, rtol=1e-3)
    back = person.rotations[:, 2, 2] < -0.8
    assert (painted.along[back] == 1).all(), "what faces away is not seen"
    around = count_pixels(person, where, cameras, [0, 1, 2])
    assert (around.along.amax(1) < 0.8).sum() > 1.3 * (painted.along.amax(1) < 0.8).sum(), "more cameras tell more"


def test_what_one_camera_sees_aslant_another_sees_straight(standing):
    person, where = standing
    cameras = views(silhouettes(person, where))
    side, front = person.rotations[:, 0, 2].abs() > 0.95, person.rotations[:, 2, 2] > 0.8
    seen = count_pixels(person, where, cameras, [0]).inside > 0
    one, three = (bake.recolor(person, where, cameras, frames)[1].aslant for frames in ([0], [0, 1, 2]))
    assert (side & seen).sum() > 20 and one[side & seen].median() > 0.3 and three[side & seen].median() < 0.05
    assert one[front & seen].median() < 0.05 and ((one >= 0) & (one <= 1)).all() and (one[~seen] == 1).all()


def test_a_far_side_that_shines_through_the_near_one_has_not_been_shown(standing):
    """A front that is not opaque lets colours of the back learn what no frame shows of them: pale patches."""
    person, where = standing
    sheer = person._replace(opacities=torch.full_like(person.opacities, 0.5))
    far = person.rotations[:, 2, 2] < -0.8
    pale = sheer._replace(sh=torch.where(far[:, None, None], 2.0, person.sh))
    cameras = views(silhouettes(person, where))
    splats = where.posed(rest(pale, where.canonical_bones()), 0)
    camera = Camera(cameras.viewmats[0], cameras.Ks[0], SIZE, SIZE)
    through = compose(splats, None, camera)[0].image - drawn(sheer, where, 0).image
    assert far.sum() > 300 and through.amax() > 0.1, "the back does shine through"
    out, *_ = bake.recolor(pale, where, cameras, [0])
    assert (out.sh - person.sh)[far].abs().mean() < 0.1 * (pale.sh - person.sh)[far].abs().mean()


@pytest.mark.parametrize("antialias", [False, True])
def test_what_nothing_covers_paints_as_many_pixels_as_its_ellipse_has(standing, antialias):
    person, where = standing
    cameras = views(silhouettes(person, where))
    one = Canonical(*(part[::500] for part in person))
    splats = where.posed(rest(one, where.canonical_bones()), 0)._replace(antialias=antialias)
    splats = splats._replace(axes=splats.axes * torch.tensor([3.0, 1, 0.3]))
    everything = torch.ones(SIZE, SIZE, 3)
    found = painted.uncovered_pixels(splats, cameras.viewmats[0], cameras.Ks[0])
    for i, size in enumerate(found):
        alone = Splats(*(part[i : i + 1] for part in splats[:4]), None, antialias)
        paints = painted_pixels(alone, cameras.viewmats[0], cameras.Ks[0], everything)[0, 0]
        assert paints == pytest.approx(size.item(), rel=0.12)  # a tail below 1/255 is not drawn


def test_skin_that_shines_through_cloth_takes_the_colours_around(standing, monkeypatch):
    """It learned what the cloth before it gets wrong: bright specks where a knee lifts a skirt."""
    person, where = standing
    front = (person.rotations[:, 2, 2] > 0.5) & (person.means[:, 1].abs() < 0.2)
    apron = Canonical(*(part[front] for part in person))
    apron = apron._replace(
        means=apron.means + torch.tensor([0.0, 0, 0.05]), opacities=torch.full_like(apron.opacities, 0.85)
    )
    hung = Hung(apron.means[:1], where.weights[:1])
    pad = torch.nn.functional.pad
    own = torch.cat([0 * apron.weights, torch.ones(len(apron.means), 1)], 1)
    flat = Surfels(apron.means, apron.rotations, apron.scales, own)
    clothed = where._replace(
        clothing=Clothing.start(hung, where.joints, where.body_pose), cloth=flat, weights=pad(where.weights, (0, 1))
    )
    bright = person._replace(sh=torch.where(front[:, None, None], 2.0, person.sh), weights=pad(person.weights, (0, 1)))
    both = Canonical(*map(torch.cat, zip(bright, apron._replace(weights=own), strict=True)))
    cameras = views(silhouettes(person, where))
    skin = torch.cat([front, torch.zeros(len(own), dtype=torch.bool)])
    off = lambda: (bake.recolor(both, clothed, cameras, [0])[0].sh[skin] - person.sh[front]).abs().mean()  # noqa: E731
    assert front.sum() > 100 and off() < 0.3
    monkeypatch.setattr(bake, "COVERED", (-2.0, -1.0))
    assert off() > 1.5, "the test can fail"


def test_a_back_that_no_frame_shows_does_not_take_the_colours_of_a_small_patch(standing, monkeypatch):
    """A pale collar was all that is near to a strip of the back, through the neck: a pale stripe."""
    person, where = standing
    cameras = views(silhouettes(person, where))
    back = (person.rotations[:, 2, 2] < -0.8) & (where.weights[:, [3, 6, 9]].sum(1) > 0.5)
    inside, edge, *_ = count_pixels(person, where, cameras, [0])
    front = ((inside > bake.SURE * inside.mean()) & (inside > 2 * edge)).nonzero()[:, 0]
    asked = nearest(person.means[front], person.means[back], bake.NEIGHBOURS)[1].flatten()
    collar = front[asked.bincount().argsort(descending=True)[:40]]  # nearest to most of the back
    pale = person._replace(sh=person.sh.index_fill(0, collar, 2.0))
    striped = lambda: (bake.recolor(pale, where, cameras, [0])[0].sh - person.sh)[back].abs().amax((1, 2)) > 0.5  # noqa: E731
    assert not striped().any()
    monkeypatch.setattr(bake, "NEAR", torch.inf)
    monkeypatch.setattr(bake, "FAR", torch.inf)
    assert striped().sum() > 10, "the test can fail"


def test_hands_that_are_hardly_more_than_outline_ask_hands(standing, monkeypatch):
    """In small pictures no colour of a hand is sure; it took those of sleeves and became purple."""
    person, where = standing
    hands = where.weights[:, 20:24].sum(1) > 0.5
    bare = person._replace(sh=torch.where(hands[:, None, None], 2.0, person.sh))
    monkeypatch.setattr(painted, "EDGE", 0.022)
    cameras = views(silhouettes(person, where))
    off = lambda: (bake.recolor(bare, where, cameras, [0])[0].sh - bare.sh)[hands].abs().mean()  # noqa: E731
    assert off() < 0.05
    monkeypatch.setattr(bake, "FAIR", (1e9, 0.9))
    assert off() > 0.5, "the test can fail"


def test_frames_are_asked_among_those_that_show_the_person(standing):
    _, where = standing
    masks = torch.zeros(200, 8, 8)
    masks[[37, 41, 90]] = 1
    where = where._replace(confidence=torch.ones(200).index_fill(0, torch.tensor([41]), 0))
    look = Views(
        masks[..., None].expand(-1, -1, -1, 3), masks, torch.eye(4).expand(200, 4, 4), torch.eye(3).expand(200, 3, 3)
    )
    assert person_frames(where, look, list(range(200))) == [37, 90], "few of many"
    assert person_frames(where, look, [0, 1]) == []


def test_a_person_is_judged_as_it_is_drawn(standing):
    person, where = standing
    resting = rest(person, where.canonical_bones())
    assert where._replace(antialias=True).posed(resting, 0).antialias and not where.posed(resting, 0).antialias


def test_what_floats_beside_the_person_is_left_out(standing):
    person, where = standing
    person = person._replace(scales=person.scales / 1.5)  # as the body has them
    tip = person.means[:, 0].topk(2).indices  # of a hand
    ends = Canonical(*(part[tip] for part in person))
    floaters = ends._replace(means=ends.means + torch.tensor([0.06, 0, 0]), scales=torch.full_like(ends.scales, 0.01))
    cloud = ends._replace(scales=ends.scales + torch.tensor([0, 0, 0.03]))
    found = bake.floating(Canonical(*map(torch.cat, zip(person, floaters, cloud, strict=True))), where)
    assert not found[:-4].any() and found[-4:].all()


def test_long_axes_are_cut_and_the_others_stay(standing):
    person, _ = standing
    most = 1.2 * person.scales.amax(1)
    needles, scales = person.scales.clone(), person.scales.clone()
    needles[::3, 1], scales[::3, 1] = 4 * most[::3], most[::3]
    short, count = bake.shorten(person._replace(scales=needles), most)
    assert torch.equal(short.scales, scales) and count == len(needles[::3])
    assert all(a is b for name, a, b in zip(Canonical._fields, short, person, strict=True) if name != "scales")


@pytest.mark.slow
def test_finishing_cuts_axes_by_the_length_they_began_with(standing):
    person, where = standing
    needles, most = person.scales.clone(), bake.SHORT * person.scales.amax(1)
    needles[::3, 1] *= 2.5
    long = person._replace(scales=needles)
    done, stay = (
        bake.finish(long, person, where, views(silhouettes(person, where)), [0, 1, 2]),
        ~bake.floating(long, where),
    )
    assert (
        done.counts["strays"] == (~stay).sum() < 0.05 * len(stay) and done.counts["shortened"] == stay[::3].sum() > 1000
    )
    kept = done.person.scales[: -done.counts["lining"]]
    assert torch.equal(kept, torch.minimum(needles, most[:, None])[stay])

"""What the person hides in every frame gets a surface that goes on as what is around it."""

from dataclasses import dataclass

import pytest
import torch

from stages.avatar.drawing.cast import Cast
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import sh_from_rgb
from stages.training.finishing.hidden import THICK, fill_hidden, seen_behind
from stages.training.step.behind import beside_and_behind
from stages.training.step.losses import dilated
from stages.training.views import Views
from tests.made.learned import compose

SIZE, FOCAL, AWAY = 96, 90.0, 4.0
GHOST = torch.tensor([1.0, 0.0, 1.0])


def stripes(points):
    """Level stripes of 0.5 m."""
    return torch.where(torch.sin(4 * torch.pi * points[:, 1:2]) > 0, 0.8, 0.2).expand(-1, 3).contiguous()


def wall(places, half=2.5, apart=0.03):
    """A striped wall AWAY m off, filmed from each of `places` m to the side; a ghost of somebody who stands at 0 m hides it."""
    side = torch.arange(-half, half, apart)
    grid = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    points = torch.cat([grid, torch.full((len(grid), 1), AWAY)], 1)
    scene = SceneModel(points, stripes(points), 0, AWAY)
    with torch.no_grad():
        scene.log_scales.fill_(torch.tensor(0.7 * apart).log())
        scene.logit_opacities.fill_(3.0)
    viewmats = torch.eye(4).repeat(len(places), 1, 1)
    viewmats[:, 0, 3] = -torch.tensor(places)
    Ks = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]).repeat(len(places), 1, 1)
    views = Views(torch.zeros(len(places), SIZE, SIZE, 3).byte(), masks_of(places), viewmats, Ks)
    images = [drawn(scene, views, i).image.detach() for i in range(len(places))]
    return scene, views._replace(images=(255 * torch.stack(images)).clamp(0, 255).byte())


def masks_of(places, at=0.0):
    """Somebody 1 m wide and 2 m high who stands at `at` m, 0.2 m before the wall."""
    masks = torch.zeros(len(places), SIZE, SIZE).byte()
    for mask, place in zip(masks, places):
        middle, scale = SIZE / 2 + FOCAL * (at - place) / (AWAY - 0.2), FOCAL / (AWAY - 0.2)
        mask[
            round(SIZE / 2 - scale) : round(SIZE / 2 + scale),
            max(0, round(middle - 0.5 * scale)) : round(middle + 0.5 * scale),
        ] = 255
    return masks


@dataclass
class Ghost:
    """Somebody who stands still, as a `Cast` has people."""

    still: Splats

    def shown(self, frame):
        return True

    def splats(self, frame):
        return self.still


def cast_of(*people):
    return Cast([Ghost(one) for one in people], None, FrameEffects())


def haunt(scene, at=0.0):
    """Somebody's ghost on the wall."""
    behind = ((scene.means[:, 0] - at).abs() < 0.5) & (scene.means[:, 1].abs() < 1)
    with torch.no_grad():
        scene.sh0[behind] = sh_from_rgb(GHOST)[None]


def drawn(scene, views, i):
    return compose(None, scene.splats().detach(), Camera(views.viewmats[i], views.Ks[i], SIZE, SIZE))[0]


def test_the_wall_goes_on_where_somebody_always_stood():
    scene, views = wall([-0.05, 0.0, 0.05])
    clean = drawn(scene, views, 1)
    haunt(scene)
    before, rows = drawn(scene, views, 1), [row.detach().clone() for row in (scene.means, scene.sh0)]
    hole = torch.as_tensor(seen_behind(scene.splats().detach(), views, 1, [0, 1, 2], cast_of()).never)
    assert hole.sum() > 500 and not (hole & (dilated(views.masks[1].float(), 0.01) == 0)).any()
    filled = fill_hidden(scene, views, [0, 1, 2], cast_of()).sum()
    after = drawn(scene, views, 1)
    assert filled == hole.sum()
    ghost, left = ((one.image - clean.image).abs()[hole].mean() for one in (before, after))
    assert left < 0.25 * ghost, (left, ghost)
    depth = (after.depth / after.alpha)[hole]
    assert (depth - AWAY).abs().max() < 0.05, "the wall is flat there, too"
    assert torch.equal(scene.means[:100], rows[0][:100]) and torch.equal(scene.sh0[:100], rows[1][:100])
    assert all(getattr(scene, name).requires_grad and len(getattr(scene, name)) == len(scene) for name in scene.ROWS)


def test_what_a_frame_shows_stays():
    scene, views = wall([-1.0, 0.0, 1.0])
    haunt(scene)
    views = views._replace(
        masks=torch.stack([masks_of([place], place)[0] for place in (-1.0, 0.0, 1.0)])
    )  # walks along
    before, splats = scene.means.detach().clone(), scene.splats().detach()
    assert not seen_behind(splats, views, 1, [0, 1, 2], cast_of()).never.any()
    assert seen_behind(splats, views, 1, [1], cast_of()).never[views.masks[1] > 0].all()
    assert fill_hidden(scene, views, [0, 1, 2], cast_of()).sum() == 0 and torch.equal(scene.means, before)
    assert fill_hidden(scene, views, [1], cast_of()).sum() > 0, "one frame alone does not show it"


def test_a_camera_that_looks_the_other_way_shows_nothing_of_what_is_behind_it():
    scene, views = wall([0.0, 0.0, 0.0])
    views.viewmats[1, [0, 2], [0, 2]] = -1.0  # turned about
    views.viewmats[2, [1, 2], [1, 2]] = -1.0  # tipped over
    views.masks[1:] = 0
    splats = scene.splats().detach()
    alone, among = (seen_behind(splats, views, 0, frames, cast_of()).never for frames in ([0], [0, 1, 2]))
    assert alone.sum() > 500 and (among == alone).all()


def test_what_one_frame_shows_is_taken_from_it_and_not_invented():
    scene, views = wall([0.0] * 12)
    clean = drawn(scene, views, 0).image.detach()
    views = views._replace(masks=torch.cat([views.masks[1:], masks_of([0.0], 3.0)]))
    views.images[-1, 40:56, 40:56] = torch.tensor([200, 0, 0])  # a poster that no patch can know of
    haunt(scene)
    invented = fill_hidden(scene, views, list(range(12)), cast_of())
    image = drawn(scene, views, 0).image
    assert not invented.any() and (image[44:52, 44:52] - torch.tensor([200, 0, 0]) / 255).abs().mean() < 0.1
    beside = (views.masks[0] > 0).clone()
    beside[38:58, 38:58] = False
    assert (image - clean).abs()[beside].mean() < 0.1


@pytest.mark.parametrize("mask", [0, 255])
def test_without_anybody_or_anything_around_all_stays(mask):
    scene, views = wall([0.0, 0.05])
    before = scene.means.detach().clone()
    filled = fill_hidden(scene, views._replace(masks=torch.full_like(views.masks, mask)), [0, 1], cast_of())
    assert not filled.any()
    assert torch.equal(scene.means, before)


def test_somebody_who_stands_here_and_then_there_leaves_two_places():
    places = [-3.0, -2.95, 3.0, 3.05]
    scene, views = wall(places, half=5.0)
    views = views._replace(masks=torch.cat([masks_of(places[:2], -3.0), masks_of(places[2:], 3.0)]))
    clean = [drawn(scene, views, i).image for i in (0, 2)]
    haunt(scene, -3.0)
    haunt(scene, 3.0)
    ghosts = [(drawn(scene, views, i).image - image).abs().mean() for i, image in zip((0, 2), clean)]
    fill_hidden(scene, views, [0, 1, 2, 3], cast_of())
    for i, image, ghost in zip((0, 2), clean, ghosts):
        assert (drawn(scene, views, i).image - image).abs().mean() < 0.35 * ghost


def behind_a_table():
    """The wall with a table before it, 2 m off, that hides somebody's legs."""
    scene, views = wall([0.0, 0.02])
    table = scene.means.detach()[scene.means[:, 1] > 0] * torch.tensor([1, 0.4, 0]) + torch.tensor([0, 0.12, 2.0])
    colours = torch.full_like(table, 0.4)
    scene.exchange(torch.zeros(len(scene), dtype=torch.bool), table, colours, torch.full((len(table),), 0.02))
    views.masks[:, round(SIZE / 2 + 0.12 / 2 * FOCAL) :] = 0
    return scene, views


def test_nothing_is_put_before_the_person():
    grid = wall([0.0])[0].means.detach()
    there = grid * torch.tensor([0.2, 0.4, 0]) + torch.tensor([0, 0, 3.8])
    person = SceneModel(there, stripes(there), 0, AWAY).splats().detach()
    for cast, before in ((cast_of(), True), (cast_of(person), False)):
        scene, views = behind_a_table()
        assert fill_hidden(scene, views, [0, 1], cast).sum() > 100
        away = scene.means[:, 2]
        assert ((away > 2.1) & (away < 3.8 + 0.5 * THICK)).any() == before, "the table is around the hole, too"


def test_what_is_farther_and_seen_from_elsewhere_is_kept():
    scene, views = wall([-1.0, 0.0, 1.0])
    far = scene.means.detach() * 3
    scene.exchange(
        scene.means[:, 0].abs() < 0.3, far, stripes(far), torch.full((len(far),), 0.06)
    )  # through a gap in the wall
    views = views._replace(masks=torch.stack([masks_of([place], 0.0)[0] for place in (-1.0, 0.0, 1.0)]))
    fill_hidden(scene, views, [0, 1, 2], cast_of())
    painted = sum(
        beside_and_behind(SceneModel(far, stripes(far), 0, AWAY).splats().detach(), views, i)[0] for i in (0, 2)
    )
    away = scene.means[scene.means[:, 2] > 2.9 * AWAY]
    assert len(away) >= (painted > 5).sum()


def test_a_hole_is_as_deep_as_what_is_around_it_whatever_floats_there():
    scene, views = wall([0.0])
    behind = (scene.means[:, 0].abs() < 0.3) & (scene.means[:, 1].abs() < 0.7)
    there = scene.means.detach()[behind] * torch.tensor([0.75, 0.75, 0.75])
    scene.exchange(torch.zeros(len(scene), dtype=torch.bool), there, stripes(there), torch.full((len(there),), 0.03))
    found = seen_behind(scene.splats().detach(), views, 0, [0], cast_of())
    hole, inverse = found.never, found.inverse
    assert hole.sum() > 500 and abs(1 / inverse[hole] - AWAY).max() < 0.05


@pytest.mark.parametrize("antialias", [False, True])
def test_what_fills_a_hole_is_opaque(antialias):
    scene, views = wall([0.0, 0.02])
    scene.antialias = antialias
    hole = torch.as_tensor(seen_behind(scene.splats().detach(), views, 0, [0, 1], cast_of()).never)
    count = len(scene)
    filled = fill_hidden(scene, views, [0, 1], cast_of()).sum()
    alone = scene.splats().detach().rows(torch.arange(len(scene)) >= len(scene) - filled)
    alpha = compose(None, alone, Camera(views.viewmats[0], views.Ks[0], SIZE, SIZE))[0].alpha
    assert filled and count and alpha[hole].quantile(0.1) > 0.9


def test_a_large_hole_has_fewer_and_larger_gaussians(monkeypatch):
    monkeypatch.setattr("stages.training.finishing.hidden.MOST", 300)
    scene, views = wall([0.0, 0.02])
    clean = drawn(scene, views, 0)
    haunt(scene)
    ghost = (drawn(scene, views, 0).image - clean.image).abs().mean()
    assert 100 < fill_hidden(scene, views, [0, 1], cast_of()).sum() <= 400
    assert (drawn(scene, views, 0).image - clean.image).abs().mean() < 0.5 * ghost


def test_a_wall_that_ends_behind_somebody_gives_finite_rows():
    scene, views = wall([0.0, 0.05])
    scene.exchange(scene.means[:, 0] > 0, torch.tensor([[0.0, 0, 50]]), GHOST[None], torch.tensor([0.1]))
    assert (drawn(scene, views, 0).alpha[:, -20:] == 0).all()
    assert fill_hidden(scene, views, [0, 1], cast_of()).sum() > 100
    assert all(getattr(scene, name).isfinite().all() for name in scene.ROWS)

"""Passers-by are outvoted by other frames and teach nothing."""

import numpy as np
import pytest
import torch

from stages.avatar.rasterize import Rendering
from stages.training.step.transients import WARM_UP, Transients
from stages.training.views import Views

FRAMES, WIDTH, HEIGHT, FOCAL, AWAY, PASSED = 6, 96, 72, 80.0, 4.0, 2
BALL = np.s_[20:44, 30:54]


def look(x, y):
    """Colours of a wall of broad blots at places x, y in m."""
    return np.stack([0.5 + 0.4 * np.sin(3 * x + p) * np.cos(2.5 * y - p) for p in (0, 1, 2)], -1)


@pytest.fixture(scope="module")
def clip():
    """Cameras that move along a wall, each with a true picture of it; in frame PASSED a ball is before it."""
    shifts = np.linspace(-0.5, 0.5, FRAMES)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = (column - WIDTH / 2) / FOCAL * AWAY, (row - HEIGHT / 2) / FOCAL * AWAY
    walls = torch.tensor(np.stack([look(x + s, y) for s in shifts])).float()
    images = walls.clone()
    images[PASSED][BALL] = torch.tensor([1.0, 0.0, 1.0])
    viewmats = torch.eye(4).repeat(FRAMES, 1, 1)
    viewmats[:, 0, 3] = -torch.tensor(shifts)
    Ks = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]).repeat(FRAMES, 1, 1)
    masks = torch.zeros(FRAMES, HEIGHT, WIDTH, dtype=torch.uint8)
    return Views((images * 255).round().byte(), masks, viewmats, Ks), walls, images


DEPTH, ALPHA = torch.full((HEIGHT, WIDTH), AWAY), torch.ones(HEIGHT, WIDTH)


def test_what_passes_by_is_distrusted_and_nothing_else(clip):
    views, walls, images = clip
    passing = Transients(views, list(range(FRAMES)))
    for frame in range(FRAMES):
        bad = passing(walls[frame], DEPTH, ALPHA, images[frame], frame)
        ball = torch.zeros_like(bad)
        if frame == PASSED:
            ball[BALL] = True
            assert bad[ball].float().mean() > 0.95 and bad[~ball].float().mean() < 0.06
        else:
            assert not bad.any()
    assert list(passing.found("abcdef")) == ["c"] and passing.found("abcdef")["c"] > 0.08


def test_what_is_not_learned_yet_is_trusted(clip):
    views, _, images = clip
    passing = Transients(views, list(range(FRAMES)))
    blank = torch.full((HEIGHT, WIDTH, 3), 0.5)
    for frame in {0, 1, 3, 4, 5}:
        assert passing(blank, DEPTH, ALPHA, images[frame], frame).float().mean() < 0.02


def test_too_few_frames_outvote_nobody(clip):
    views, walls, images = clip
    for voters, some in (([1, PASSED, 3], False), ([0, 1, PASSED, 3], True)):
        bad = Transients(views, voters)(walls[PASSED], DEPTH, ALPHA, images[PASSED], PASSED)
        assert bool(bad.any()) is some


def test_no_depth_and_no_picture_of_the_place_cast_no_votes(clip):
    views, walls, images = clip
    passing = Transients(views, list(range(FRAMES)))
    nothing, away = torch.zeros(HEIGHT, WIDTH), torch.eye(4)
    away[0, 3] = 100.0
    assert not passing(walls[PASSED], nothing, nothing, images[PASSED], PASSED).any()
    others = views._replace(viewmats=torch.stack([views.viewmats[i] if i == PASSED else away for i in range(FRAMES)]))
    assert not Transients(others, list(range(FRAMES)))(walls[PASSED], DEPTH, ALPHA, images[PASSED], PASSED).any()
    turned = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    others = views._replace(viewmats=torch.stack([views.viewmats[i] if i == PASSED else turned for i in range(FRAMES)]))
    assert not Transients(others, list(range(FRAMES)))(walls[PASSED], DEPTH, ALPHA, images[PASSED], PASSED).any()


def test_people_in_other_frames_do_not_vote(clip):
    views, walls, images = clip
    masks = torch.full_like(views.masks, 255)
    masks[PASSED] = 0
    assert not Transients(views._replace(masks=masks), list(range(FRAMES)))(
        walls[PASSED], DEPTH, ALPHA, images[PASSED], PASSED
    ).any()


def test_distrusted_pixels_have_no_gradient_and_the_others_all_of_it(clip):
    views, walls, images = clip
    transients = Transients(views, list(range(FRAMES)))
    drawn = Rendering(walls[PASSED], ALPHA, DEPTH, *[torch.zeros(0)] * 4, 0)
    picture = (walls[PASSED] + 0.01).requires_grad_()
    args = drawn, images[PASSED], PASSED
    assert transients.replace(picture, *args, 0.5 * WARM_UP) is picture, "too early"
    (transients.replace(picture, *args, 0.9) - images[PASSED]).square().sum().backward()
    bad = transients(picture.detach(), DEPTH, ALPHA, images[PASSED], PASSED)
    assert (picture.grad[bad] == 0).all() and bad[BALL].all()
    slope = 2 * (picture.detach() - images[PASSED])
    torch.testing.assert_close(picture.grad[~bad], slope[~bad], rtol=0, atol=0)

"""First colours: what faces a camera takes its colour, what faces none takes its neighbour's and is known as unseen."""

import pytest
import torch

from stages.training.beginning.init_colors import seen_colors
from stages.training.views import Views
from tests.made.standing import around, stand

SIZE = 64
RED, BLUE = torch.tensor([200, 20, 20], dtype=torch.uint8), torch.tensor([20, 20, 200], dtype=torch.uint8)


@pytest.fixture(scope="module")
def standing():
    """The free body and a person who stands at the origin in two frames, without Gaussians between the vertices."""
    return stand(2)


def views():
    """A red picture from the front (the body faces +z) and a blue one from behind, all of them person."""
    images = torch.stack([colour.expand(SIZE, SIZE, 3) for colour in (RED, BLUE)])
    masks = torch.full((2, SIZE, SIZE), 255, dtype=torch.uint8)
    return Views(images, masks, *around(((0, 0, 3), (0, 0, -3)), 60.0, SIZE))


def normals(human):
    return human.rotations[:, :, 2]


def test_both_sides_take_the_colour_of_their_camera(standing):
    human, person = standing
    colors, known = seen_colors(human, person, views(), [0, 1] * 3)
    front, back = normals(human)[:, 2] > 0.9, normals(human)[:, 2] < -0.9
    assert front.sum() > 300 and back.sum() > 300
    assert torch.allclose(colors[front], RED / 255, atol=1e-5) and torch.allclose(colors[back], BLUE / 255, atol=1e-5)
    assert (known[front | back] == 1).all()


def test_a_side_never_seen_takes_its_neighbours_colour_and_is_known_as_unseen(standing):
    human, person = standing
    colors, known = seen_colors(human, person, views(), [0] * 6)
    back = normals(human)[:, 2] < 0
    assert torch.allclose(colors, (RED / 255).expand_as(colors), atol=1e-5)
    assert (known[back] == 0).all() and 0.2 < known.mean() < 0.6


def test_nobody_in_the_masks_is_grey_and_unseen(standing):
    human, person = standing
    empty = views()._replace(masks=torch.zeros(2, SIZE, SIZE, dtype=torch.uint8))
    colors, known = seen_colors(human, person, empty, [0, 1])
    assert (colors == 0.5).all() and (known == 0).all()

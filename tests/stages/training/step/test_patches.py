"""The perceptual term: when it is due, where it looks, what it weighs."""

import pytest
import torch

from stages.training.settings import Params
from stages.training.step.patches import SIDE, PatchLoss


class Far:
    """In place of LPIPS: the mean difference of each picture, and what it was shown, all patches of a step at once."""

    smallest = 32

    def __init__(self):
        self.shown = []

    def __call__(self, image, truth):
        self.shown += truth
        return (image - truth).abs().mean((1, 2, 3))


EVERYWHERE, BLACK = torch.ones(400, 400), torch.zeros(3)


def over(image):
    """What the term is given beside a rendering: a picture that shows the person everywhere."""
    return image, EVERYWHERE[: len(image), : len(image[0])], BLACK


def made(**settings):
    network = Far()
    settings = {"perceptual_every": 1} | settings
    return network, PatchLoss(network, Params(**settings), torch.Generator().manual_seed(0))


def test_it_is_due_every_so_many_steps_and_never_without_a_network():
    network, loss = made(perceptual_every=4)
    image = torch.rand(200, 200, 3)
    assert [loss(step, image + 1, *over(image)) == 0 for step in range(5)] == [False, True, True, True, False]
    assert len(network.shown) == 2
    assert PatchLoss(None, Params(), torch.Generator())(0, image + 1, *over(image)) == 0


def test_it_is_the_weighted_mean_of_its_patches():
    network, loss = made(perceptual_weight=0.7, perceptual_patches=4)
    image = torch.rand(300, 400, 3)
    assert loss(0, image + 0.5, *over(image)).item() == pytest.approx(0.35, abs=1e-6)
    assert len(network.shown) == 4 and all(patch.shape == (SIDE, SIDE, 3) for patch in network.shown)
    assert not torch.equal(network.shown[0], network.shown[1])  # elsewhere each time


def test_patches_of_the_person_lie_on_the_person_before_the_background():
    network, loss = made(perceptual_patches=3)
    mask = torch.zeros(400, 400)
    mask[300:, 300:] = 1
    background = torch.tensor([0.2, 0.4, 0.6])
    loss(0, torch.zeros(400, 400, 3), torch.ones(400, 400, 3), mask, background)
    for patch in network.shown:
        person = (patch == 1).all(-1)
        assert person.any() and torch.allclose(patch[~person], background)


def test_a_picture_too_small_for_the_network_counts_nothing_and_gradients_flow():
    _, loss = made()
    small = torch.zeros(20, 200, 3, requires_grad=True)
    assert loss(0, small, *over(torch.ones(20, 200, 3))) == 0
    large = torch.zeros(64, 200, 3, requires_grad=True)
    loss(0, large, *over(torch.ones(64, 200, 3))).backward()
    assert torch.isfinite(large.grad).all() and large.grad.abs().sum() > 0

"""Several people in a frame: who hides whom, and that what nobody can tell is not compared."""

import pytest
import torch

from stages.training.step.losses import where_known
from stages.training.step.outlines import outlines
from tests.made.training import FRAMES
from tests.made.two import make_two

clip = pytest.fixture(scope="module")(make_two)


def test_who_is_nearer_hides_and_is_hidden_by_nobody(clip):
    views, people, masks = clip
    red, blue = outlines(views, masks, people)
    assert not red.hidden.any(), "nobody stands before the red one"
    assert (blue.hidden[masks[0] > 0] == 255).all() and (blue.hidden > 0).float().mean() < 0.3
    assert blue.clear([0, FRAMES - 1]) == [0, FRAMES - 1], "fewer than CLEAR: all"
    assert {0, FRAMES - 1} & {i for i in range(FRAMES) if not blue._touched(i)}
    crossing = masks[1].flatten(1).sum(1).argmin()
    assert blue._touched(int(crossing)) and not red._touched(int(crossing))


def test_where_no_fit_tells_who_is_nearer_both_are_hidden(clip):
    views, people, masks = clip
    beside = people[1]._replace(transl=people[1].transl - torch.tensor([0, 0, 0.7]))
    unsure = people[1]._replace(confidence=torch.zeros(FRAMES))
    for other in (beside, unsure):
        red, _ = outlines(views, masks, [people[0], other])
        assert (red.hidden[masks[1] > 0] == 255).all()


def test_what_two_masks_claim_teaches_nobody(clip):
    views, people, masks = clip
    masks = [mask.clone() for mask in masks]
    there = masks[0][0] > 127
    masks[0][0][there] = 0  # as `masks` writes a pixel that two claim
    for one in outlines(views, masks, people):
        assert (one.hidden[0][there] == 255).all()


def test_where_nobody_can_tell_nothing_is_compared():
    image, mask, background = torch.rand(6, 5, 3), torch.rand(6, 5), torch.rand(3)
    rendered, alpha, known = (
        torch.rand(6, 5, 3, requires_grad=True),
        torch.rand(6, 5, requires_grad=True),
        torch.ones(6, 5),
    )
    known[2:4] = 0
    shown, covers = where_known(rendered, alpha, known, (image, mask, background))
    (shown.sum() + covers.sum()).backward()
    assert rendered.grad.any() and not rendered.grad[2:4].any() and not alpha.grad[2:4].any()
    assert torch.equal(covers[2:4], mask[2:4]) and torch.equal(shown[:2], rendered[:2])

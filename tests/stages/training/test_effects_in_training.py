"""What the effects that change learning are in a whole training: nothing where they are off, resumable where they are on."""

import pytest
import torch

from stages.avatar.effects.frames import FrameEffects
from stages.training.step.transients import Transients
from tests.made.training import TRAIN, everything, fit_of, make_clip, posed, run, same, stored

clip = pytest.fixture(scope="module")(make_clip)


@pytest.mark.slow
def test_h11_resumed_equals_uninterrupted_bit_for_bit_with_all_of_them(clip):
    straight, first, second = (everything(clip) for _ in range(3))
    run(straight, 24)
    run(first, 11)
    assert (
        first.people[0].body.clothing.swings.abs().max() > 0
        and first.people[0].corrections.swing.weight.abs().max() > 0
    ), "clothes are learned"
    second.load(stored(first))
    run(second, 24)
    assert same(straight, second) and straight.guard.left_out == 0
    assert (straight.scene.means.norm(dim=1) > 200).sum() >= 3, "the sky stays where it is"


@pytest.mark.slow
def test_what_is_off_changes_no_bit(clip):
    plain, off, on = fit_of(clip, steps=12), fit_of(clip, steps=12), fit_of(clip, steps=12)
    off.effects = FrameEffects()
    on.transients = Transients(clip[0], TRAIN)
    on.transients.cells.fill_(0.3)  # all other frames show grey
    for fit in (plain, off, on):
        run(fit, 12)
    assert same(plain, off)
    assert not torch.equal(plain.scene.sh0, on.scene.sh0), "else this test says nothing"


def test_clothes_move_the_person_that_is_drawn_and_judged(clip):
    fit = everything(clip)
    body = [part[1] for part in clip[1][:3]]
    resting, clothing = fit.people[0].resting(), fit.people[0].body.clothing
    before = posed(fit, resting, *body).means
    with torch.no_grad():
        clothing.swings[:, 3:, 1] = 0.4
    moved = posed(fit, resting, *body)
    own = resting.weights[:, 24:].sum(1)
    shift = 0.02 * clothing.features(body[1])[1].abs() * 3**0.5
    torch.testing.assert_close((moved.means - before).norm(dim=1), own * shift, rtol=0.05, atol=2e-4)
    assert own.max() > 0.9 and moved.antialias and fit.scene.splats().antialias
    torch.testing.assert_close(fit.people[0].body.posed(resting, 1).means, moved.means, rtol=0, atol=1e-6)
    with torch.no_grad():
        fit.people[0].corrections.swing.weight[1] = 0.3
    assert torch.equal(posed(fit, resting, *body).means, moved.means)
    gone = (posed(fit, resting, *body, frame=1).means - moved.means).norm(dim=1)
    assert gone[own > 0.9].min() > 0.01 and gone[own < 0.01].max() < 1e-3, (
        "a frame's swing is that of cloth in that frame"
    )

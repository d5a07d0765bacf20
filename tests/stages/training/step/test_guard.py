"""What one bad gradient may do to Adam, and what stops a training."""

import copy

import pytest
import torch

from stages.training.step.guard import ABSURD, BAD_STEPS, QUIET, YOUNG, Guard


def gradients(seed: int, rows: int = 40) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {"means": torch.randn(rows, 3, generator=g), "opacities": torch.randn(rows, generator=g)}


def test_h01_rows_that_are_not_finite_are_zeroed_in_all_tensors_and_counted():
    guard, grads = Guard(), gradients(0)
    clean = copy.deepcopy(grads)
    grads["means"][1, 2], grads["opacities"][3], grads["means"][5, 0] = torch.nan, torch.inf, -torch.inf
    guard.contain("scene", grads)
    assert guard.left_out == 3
    for name, grad in grads.items():
        kept = [i for i in range(40) if i not in (1, 3, 5)]
        assert (grad[[1, 3, 5]] == 0).all() and torch.equal(grad[kept], clean[name][kept])


def test_h02_ordinary_gradients_pass_to_the_bit_and_absurd_ones_do_not():
    guard = Guard()
    for seed in range(20):
        grads = gradients(seed)
        grads["means"][7] *= 30 if seed % 3 else 1  # as uneven as a real clip's
        clean = copy.deepcopy(grads)
        guard.contain("scene", grads)
        assert all(torch.equal(grads[name], clean[name]) for name in grads)
    assert guard.left_out == 0
    usual = guard.usual["scene.means"]
    for factor, left_out in ((0.9, 0), (1.1, 1)):
        grads = gradients(99)
        grads["means"][4, 1] = factor * ABSURD * usual
        guard.contain("scene", grads)
        assert guard.left_out == left_out and (grads["opacities"][4] == 0) == bool(left_out)
        guard.usual["scene.means"] = usual


def test_h02_a_row_that_stays_absurd_never_becomes_usual():
    guard = Guard()
    for seed in range(60):
        grads = gradients(seed, 400)
        if seed > 10:
            grads["means"][4] *= 1e12
        guard.contain("scene", grads)
        assert grads["means"].abs().max() < 10
    assert guard.left_out == 49


def test_h02_a_training_that_grows_louder_is_let_through():
    guard = Guard()
    for seed in range(30):
        grads = {name: g * 2.0**seed for name, g in gradients(seed).items()}
        guard.contain("scene", grads)
    assert guard.left_out == 0


@pytest.mark.parametrize("asleep", [0.0, 1e-9])
@pytest.mark.parametrize("first", [1, 40], ids=["one row first", "all at once"])
def test_h02_what_begins_at_nothing_is_let_through_when_it_wakes(asleep, first):
    """Turning a sphere has no gradient, or that of rounding; when it has one at last, that is no mistake."""
    guard = Guard()
    for seed in range(3 * YOUNG):
        grads = gradients(seed)
        grads["quats"] = gradients(100 + seed)["means"]
        grads["quats"][0 if seed < YOUNG else first :] *= asleep
        guard.contain("scene", grads)
    assert guard.left_out == 0 and (grads["quats"][:first] != 0).all()
    grads["quats"][0] = 1.1 * ABSURD * max(QUIET * guard.usual["scene.means"], guard.usual["scene.quats"])
    guard.contain("scene", grads)
    assert guard.left_out == 1, "it is guarded all the same"


def test_h02_a_faint_first_frame_is_not_what_is_usual():
    guard = Guard()
    for seed in range(3 * YOUNG):
        guard.contain("person", {name: grad * (1 if seed else 1e-6) for name, grad in gradients(seed).items()})
    assert guard.left_out == 0


@pytest.mark.parametrize("name", ["means", "opacities"])
@pytest.mark.parametrize("begun", [0, 1, YOUNG - 1, YOUNG, 3 * YOUNG])
def test_h02_one_enormous_row_is_found_at_every_age(name, begun):
    guard = Guard()
    for seed in range(begun + 3):
        grads = gradients(seed)
        if seed == begun:
            grads[name][4] *= 1e8 / grads[name][4].abs().max()
        guard.contain("scene", grads)
        assert guard.left_out == (seed >= begun) and (grads[name][4] == 0).all() == (seed == begun)
    assert max(guard.usual.values()) < 10, "nor is it learned"


def test_h02_a_frame_alone_is_compared_with_its_other_tensors():
    for begun in (0, 5):
        guard = Guard()
        for seed in range(begun + 1):
            grads = {name: grad[:1] for name, grad in gradients(seed).items()}
            grads["means"][0, 1] *= 1e9 if seed == begun else 1
            guard.contain("frames", grads)
        assert guard.left_out == 1 and max(guard.usual.values(), default=0) < 10
    alone = Guard()
    alone.contain("frames", {"gain": torch.tensor([[1e9]])})
    assert alone.left_out == 0, "with nothing beside it, and nothing before, any number is as good as another"


def spiked(spike: float, guarded: str | None) -> torch.Tensor:
    """Lengths [S] of row 2's steps by Adam at a rate of 1, after the gradient of step 50 was `spike` times the usual."""
    parameter, guard = torch.nn.Parameter(torch.zeros(200, 3)), Guard()
    adam = torch.optim.Adam([parameter], lr=1.0, eps=1e-15, fused=True)
    steps, before = [], parameter.detach().clone()
    for step in range(150):
        parameter.grad = 1 + 0.1 * torch.randn(200, 3, generator=torch.Generator().manual_seed(step))
        if step == 50:
            parameter.grad[2 if guarded == "rows" else slice(None)] *= spike  # of networks all weights share it
        if guarded == "rows":
            guard.contain("scene", {"means": parameter.grad})
        elif guarded == "norm":
            guard.clip("networks", [parameter.grad])
        adam.step()
        steps.append((parameter.detach() - before).abs().mean(1)[2])
        before = parameter.detach().clone()
    return torch.stack(steps[51:])


@pytest.mark.parametrize("guarded", ["rows", "norm"])
def test_h02_one_enormous_gradient_freezes_nothing(held, guarded):
    steps = spiked(1e12, guarded)
    held(max(0.0, 1 - steps[-1].item()), 0.5, "what is missing of a step after 100")
    assert spiked(1e12, None)[-1] < 0.01, "without a guard the row stands still"


def test_h02_the_norm_of_networks_is_clipped_and_one_that_is_not_finite_leaves_the_step_out():
    guard, grads = Guard(), [torch.ones(4, 4), torch.ones(8)]
    for _ in range(3):
        assert guard.clip("networks", grads) and all((g == 1).all() for g in grads)
    louder = [1e6 * g for g in grads]
    assert guard.clip("networks", louder)
    assert torch.nn.utils.get_total_norm(louder).item() == pytest.approx(10 * 24**0.5)
    assert not guard.clip("networks", [torch.tensor([torch.nan])]) and guard.left_out == 1 and guard.clipped == 1


def test_h01_many_bad_steps_in_a_row_stop_and_name_the_first_row_and_few_do_not():
    guard, few = Guard(), Guard()
    for step in range(BAD_STEPS):
        assert guard.alarmed == (step == BAD_STEPS - 1)
        grads = gradients(step, 200)
        grads["means"][[5, 9, 11], 0] = torch.nan  # over 1 in 100
        one = gradients(step, 200)
        one["means"][5] = torch.nan
        few.contain("scene", one)
        if step < BAD_STEPS - 1:
            guard.contain("scene", grads)
    with pytest.raises(FloatingPointError, match=r"20 bad steps .* scene: 3 of 200 .* scene\.means row 5"):
        guard.contain("scene", grads)
    assert few.left_out == 20 and not few.alarmed


def test_h01_a_good_step_in_between_forgives():
    guard = Guard()
    for step in range(3 * BAD_STEPS):
        guard.count("loss", step % BAD_STEPS != 0, "nan")
    assert not guard.alarmed or guard.streaks["loss"] == BAD_STEPS - 1


def test_h11_a_guard_goes_on_where_it_was():
    guard, again = Guard(), Guard()
    guard.contain("scene", gradients(0))
    guard.count("loss", True, "nan")
    guard.clipped = 3
    again.load(guard.state())
    assert again.state() == guard.state() and again.streaks == {"scene": 0, "loss": 1}
    assert again.compared == {"scene": 1} and again.clipped == 3


def test_without_rows_there_is_nothing_to_judge():
    guard = Guard()
    guard.contain("scene", {"shN": torch.zeros(5, 0, 3)})
    assert guard.left_out == 0

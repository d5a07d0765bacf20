"""Adam at the ends of float32, and schedules at the ends of a training."""

import pytest
import torch

from stages.avatar.model.scene import SceneModel
from stages.training.step.optimizers import optimizers
from stages.training.step.refine import FrameCorrections
from stages.training.step.schedule import LR_FRAMES, LR_HUMAN, LR_OWN, LR_SCENE, Phase, phases, rate


@pytest.mark.parametrize("gradient", [1e-12, 1e-8, 1.0, 1e8])
def test_h04_gradients_of_any_size_make_whole_steps(gradient, held):
    scene = SceneModel(torch.rand(4, 3), torch.rand(4, 3), 0, 1.0)
    adam, before = optimizers(FrameCorrections(2), {}, scene, 1.0)["scene"], scene.sh0.detach().clone()
    for group in adam.param_groups:
        group["lr"] = group["base"]
    scene.sh0.grad = torch.full_like(scene.sh0, gradient)
    adam.step()
    held(((before - scene.sh0) / LR_SCENE["sh0"] - 1).abs().max(), 5e-3, "share of a step that is missing")
    assert {m.dtype for m in adam.state[scene.sh0].values()} == {torch.float32}


@pytest.mark.parametrize("gradient", [0.0, 1e-30, 1e-44])
def test_h04_gradients_that_vanish_make_no_step_and_nothing_else(gradient):
    scene = SceneModel(torch.rand(4, 3), torch.rand(4, 3), 0, 1.0)
    adam, before = optimizers(FrameCorrections(2), {}, scene, 1.0)["scene"], scene.sh0.detach().clone()
    for group in adam.param_groups:
        group["lr"] = group["base"]
    for _ in range(3):
        scene.sh0.grad = torch.full_like(scene.sh0, gradient)
        adam.step()
    assert torch.allclose(scene.sh0, before, atol=1e-9) and scene.sh0.isfinite().all()


def test_h15_rates_are_finite_positive_and_never_rise():
    for name in LR_HUMAN | LR_OWN | LR_SCENE | LR_FRAMES:
        rates = [rate(name, done) for done in torch.linspace(0, 1, 101).tolist()]
        assert rates == sorted(rates, reverse=True) and rates[0] == 1 and 0.01 <= rates[-1] <= 0.1 + 1e-9, name


@pytest.mark.parametrize("steps", [1, 2, 3, 4000])
@pytest.mark.parametrize("joint", [True, False])
def test_h15_phases_cover_every_step_once(steps, joint):
    found = phases(steps, joint)
    assert sum(phase.steps for phase in found) == steps and found[0] == Phase(0, found[0].steps, joint, True)
    assert all(a.first + a.steps == b.first for a, b in zip(found, found[1:], strict=False))

"""Shading: the light on the person has the mean 1, is bounded and smooth, and is the same in training and in a file."""

import numpy as np
import pytest
import torch

from stages.avatar.effects.frames import FrameEffects, load_effects
from stages.avatar.effects.shading import BANDS, HOLD, STEEPEST, Shading
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.sh import SH_C0, spread_directions
from stages.contract import StageError
from stages.formats.effects import read_effects, write_effects
from stages.records import Effects


def bands(size: float, seed: int = 0) -> torch.Tensor:
    return size * torch.randn(BANDS, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def ball(count: int = 200, dtype: torch.dtype = torch.float64) -> Splats:
    """Gaussians of one grey on a ball, each turned as it happens."""
    out, generator = spread_directions(count).to(dtype), torch.Generator().manual_seed(1)
    axes = 0.02 * torch.randn(count, 3, 3, generator=generator, dtype=dtype)
    return Splats(out, axes, torch.ones(count, dtype=dtype), torch.zeros(count, 1, 3, dtype=dtype), normals=2 * out)


def lamp(bands: torch.Tensor) -> Shading:
    shading = Shading().to(bands)
    shading.bands.data.copy_(bands)
    return shading


@pytest.mark.parametrize("size", [0.0, 0.3, 3.0, 1e6])
def test_light_from_everywhere_is_one_and_no_direction_exceeds_the_bound(size, held):
    light = lamp(bands(size)).light(spread_directions(4000))
    assert light.isfinite().all()
    held((light.mean(0) - 1).abs().max().item(), 0.15 if size > 1 else 2e-3)
    assert (light.log().amax(0) - light.log().amin(0) <= 2 * STEEPEST + 1e-9).all()
    assert (light == 1).all() or size > 0


def test_a_gaussian_shows_its_colour_times_the_light_on_its_surface(held):
    person, shading = ball(), lamp(bands(0.5))
    wanted = 0.5 * shading.light(person.means)  # grey; a ball faces outwards, however its Gaussians are turned
    lit = 0.5 + SH_C0 * shading(person).sh[:, 0]
    held((lit - wanted).abs().max().item(), 1e-12)
    assert lit.std() > 0.05


def test_gradients_are_right_also_where_the_light_is_bounded_and_nothing_is_faced():
    flat = ball(6)
    flat.normals[0] = 0.0  # it faces nowhere
    for size in (0.0, 0.4, 30.0):
        start = bands(size).requires_grad_()

        def colors(values: torch.Tensor) -> torch.Tensor:
            shading = Shading().to(values)
            del shading.bands
            shading.bands = values
            return shading(flat).sh

        assert torch.autograd.gradcheck(colors, (start,), eps=1e-7, atol=1e-6)


def test_where_a_surface_faces_is_not_learned_from_light():
    normals, shading = ball().normals.requires_grad_(), lamp(bands(0.5))
    shading(ball()._replace(normals=normals)).sh.sum().backward()
    assert normals.grad is None and shading.bands.grad is not None
    with pytest.raises(ValueError, match="normals"):
        shading(ball()._replace(normals=None))


def test_what_no_frame_tells_stays_even():
    shading = lamp(bands(1.0))
    shading.prior().backward()
    assert (shading.bands.grad * shading.bands > 0).all()
    assert lamp(torch.full((BANDS, 3), 2.0)).prior().item() == pytest.approx(4 * HOLD)


def test_off_it_is_the_very_same_person():
    person = ball()
    assert FrameEffects().lit(person) is person
    assert "shading" not in FrameEffects().known()


def test_a_file_keeps_the_light(tmp_path, held):
    effects = FrameEffects()
    effects.shading = lamp(bands(0.4).float())
    write_effects(tmp_path / "effects.npz", Effects(**effects.known()))
    loaded = load_effects(read_effects(tmp_path / "effects.npz"))
    person = ball(dtype=torch.float32)
    held((loaded.lit(person).sh - effects.lit(person).sh).abs().max().item(), 1e-6)
    assert not any(p.requires_grad for p in loaded.parameters())


@pytest.mark.parametrize("wrong", [np.zeros((9, 3)), np.full((8, 3), np.nan), np.zeros(3)])
def test_a_file_with_another_light_is_refused_by_name(tmp_path, wrong):
    np.savez(tmp_path / "effects.npz", shading=wrong)
    with pytest.raises(StageError, match="shading"):
        read_effects(tmp_path / "effects.npz")


def test_the_light_of_one_lamp_is_found_from_a_ball_that_it_lights(held):
    person = ball(600)
    towards = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    wanted = (0.3 + (person.means @ towards).clamp_min(0))[:, None].expand(-1, 3)
    wanted = wanted / wanted.mean(0)
    shading = Shading().double()
    adam = torch.optim.Adam(shading.parameters(), lr=3e-2)
    for _ in range(300):
        adam.zero_grad()
        (shading.light(person.means) - wanted).abs().mean().backward()
        adam.step()
    left = (shading.light(person.means) - wanted).square().mean().sqrt() / (wanted - 1).square().mean().sqrt()
    held(left.item(), 0.25, "of the light is not told")

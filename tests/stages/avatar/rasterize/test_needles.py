"""Long thin Gaussians: the exponent is a sum of squares, which does not cancel in float32."""

import math

import pytest
import torch

from stages.avatar.rasterize import cpu, reference
from stages.avatar.rasterize.rendering import ALPHA_MIN
from tests.made.rasterized import STRAIGHT, apart, cast, draw, show, worst

K = torch.tensor([[600.0, 0, 48], [0, 600, 32], [0, 0, 1]])
WIDTH, HEIGHT, DEPTH = 96, 64, 3.0


def needle(sigma: float, away: float, angle: float) -> tuple[torch.Tensor, ...]:
    """`sigma` px long and thinner than a pixel, across the picture's middle; its centre is `away` px along it."""
    x, y = away * DEPTH / 600 * math.cos(angle), away * DEPTH / 600 * math.sin(angle)
    quat = torch.tensor([[math.cos(angle / 2), 0, 0, math.sin(angle / 2)]])
    scales = torch.tensor([[sigma * DEPTH / 600, 1e-4, 1e-4]])
    return torch.tensor([[x, y, DEPTH]]), quat, scales, torch.tensor([0.7]), torch.ones(1, 3)


@pytest.mark.parametrize(("sigma", "bound", "slopes"), [(10, 2e-5, 4e-4), (100, 3e-5, 3e-3), (300, 3e-5, 3e-3)])
@pytest.mark.parametrize("off", [0.0, 1.5])
def test_a01_needles_are_as_opaque_as_in_float64(sigma, bound, slopes, off, held):
    """Bounds of the catalogue, 3e-5; without squares the exponent loses 4e-4 at 100 px and 5e-3 at 300."""
    errors, gradients = [], []
    for angle in (0.3, 0.8, 1.2, 2.0, 2.6):
        parts = needle(sigma, off * sigma, angle)
        fast, true = (
            show(cpu, parts, STRAIGHT, K, WIDTH, HEIGHT),
            show(reference, cast(parts), STRAIGHT, K, WIDTH, HEIGHT),
        )
        kept = true.alpha > 1.1 * ALPHA_MIN
        assert kept.sum() > 30, "the needle must be seen"
        errors += (fast.alpha - true.alpha).abs()[kept].tolist()
        (_, own), (_, exact) = (
            draw(maker, cast(parts, dtype), STRAIGHT, K, WIDTH, HEIGHT, dtype)
            for maker, dtype in ((cpu, torch.float32), (reference, torch.float64))
        )
        gradients += [apart(own[i], exact[i]) for i in (0, 1)]
    held(worst(errors), bound)
    held(worst(gradients), slopes)


@pytest.mark.parametrize(
    ("sigma", "off", "bound"), [(1000, 0, 3e-5), (1000, 1.5, 1e-4), (3000, 0, 3e-5), (3000, 1.5, 4e-4)]
)
def test_a01_needles_of_thousands_of_pixels_lose_no_more_than_their_places_do(sigma, off, bound, held):
    """A centre 4,500 px away is a float32 that is good to 2e-4 px, of a needle half a pixel wide."""
    errors = []
    for angle in (0.3, 0.8, 1.2, 2.0, 2.6):
        parts = needle(sigma, off * sigma, angle)
        fast, true = (
            show(maker, cast(parts, dtype), STRAIGHT, K, WIDTH, HEIGHT).alpha
            for maker, dtype in ((cpu, torch.float32), (reference, torch.float64))
        )
        errors += (fast - true).abs()[true > 1.1 * ALPHA_MIN].tolist()
    held(worst(errors), bound)

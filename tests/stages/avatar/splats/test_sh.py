"""Spherical harmonics: the basis, its signs, and colours clamped at black."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.splats.sh import SH_C0, bases, rotate_sh, sh_basis, sh_colors, sh_from_rgb


def sphere(n: int = 4000) -> torch.Tensor:
    """Fibonacci points: their mean over a polynomial of low degree is its integral over the sphere / 4 pi."""
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * i / n, math.pi * (1 + 5**0.5) * i
    r = (1 - z * z).sqrt()
    return torch.stack([r * angle.cos(), r * angle.sin(), z], 1)


@pytest.mark.parametrize("degree", range(4))
def test_basis_is_orthonormal(degree):
    basis = sh_basis(sphere(), degree)
    assert basis.shape[1] == bases(degree)
    gram = 4 * math.pi * basis.T @ basis / len(basis)
    assert torch.allclose(gram, torch.eye(bases(degree), dtype=torch.float64), atol=2e-3)


def test_signs_are_those_of_3dgs_files():
    basis = sh_basis(torch.eye(3), 2)
    assert basis[1, 1] < 0 and basis[2, 2] > 0 and basis[0, 3] < 0  # y, z, x
    assert basis[2, 6] > 0 and basis[0, 8] > 0


def test_rgb_round_trip_and_unknown_degree():
    rgb = torch.rand(5, 3)
    assert torch.allclose(sh_colors(sh_from_rgb(rgb)[:, None], None), rgb, atol=1e-6)
    with pytest.raises(ValueError, match="degree 4"):
        sh_basis(torch.eye(3), 4)


def test_b15_dark_colour_is_clamped_but_can_return():
    sh = torch.full((1, 1, 3), -5.0, requires_grad=True)
    color = sh_colors(sh, None)
    assert torch.equal(color, torch.zeros(1, 3))
    (brighter,) = torch.autograd.grad(-color.sum(), sh, retain_graph=True)
    assert torch.allclose(brighter, torch.full_like(sh, -SH_C0))
    (darker,) = torch.autograd.grad(color.sum(), sh)
    assert (darker == 0).all()


def test_b15_black_that_is_wanted_darker_still_does_not_sink():
    """A sum of two is too bright and one of them is black: Adam would take it down for ever, at the speed of its rate."""
    sh = torch.nn.Parameter(sh_from_rgb(torch.tensor([[0.0, 0.0, 0.0], [0.9, 0.9, 0.9]]))[:, None])
    adam = torch.optim.Adam([sh], lr=0.01, eps=1e-15)
    for _ in range(300):
        adam.zero_grad()
        (sh_colors(sh, None).sum(0) - 0.5).clamp_min(0).sum().backward()
        adam.step()
    assert (0.5 + SH_C0 * sh[0]).min() > -0.05 and (sh_colors(sh, None).sum(0) < 0.51).all()


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_turned_coefficients_show_towards_the_turned_direction_what_they_showed(degree):
    higher = torch.randn(40, bases(degree) - 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    turns = torch.as_tensor(Rotation.random(40, random_state=1).as_matrix())
    seen = sphere(40)
    before = torch.einsum("nk,nkc->nc", sh_basis(seen, degree)[:, 1:], higher)
    towards = (turns @ seen[..., None])[..., 0]
    after = torch.einsum("nk,nkc->nc", sh_basis(towards, degree)[:, 1:], rotate_sh(higher, turns))
    assert torch.allclose(after, before, atol=1e-12)
    over = rotate_sh(higher, torch.diag(torch.tensor([1.0, -1, -1])))
    signs = over / higher
    assert torch.allclose(signs.abs(), torch.ones_like(signs)), "half a turn about an axis only changes signs"
    assert rotate_sh(higher[:, :0], turns).shape == (40, 0, 3)

"""SSIM: the fused kernel against its specification, flat pictures, and what it must mean."""

import numpy as np
import pytest
import torch

from stages.avatar.measures.ssim import ssim, ssim_reference


def pair(height, width, seed=0):
    g = torch.Generator().manual_seed(seed)
    target = torch.nn.functional.interpolate(torch.rand(1, 3, 6, 6, generator=g), (height, width), mode="bilinear")
    target = target[0].permute(1, 2, 0).contiguous()
    return (target + 0.1 * torch.randn(height, width, 3, generator=g)).clamp(0, 1), target


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (7, 5), (5, 40), (45, 61), (128, 96)])
def test_g04_kernel_agrees_with_the_reference(size, held):
    image, target = pair(*size)
    image.requires_grad_()
    value = ssim(image, target)
    value.backward()
    true = image.detach().double().requires_grad_()
    expected = ssim_reference(true, target.double())
    expected.backward()
    held(abs(value.item() - expected.item()), 2e-6)
    held((image.grad - true.grad).norm() / true.grad.norm(), 2e-5)


def by_the_book(a: np.ndarray, b: np.ndarray) -> float:
    """SSIM as a direct sum over an 11x11 window of sigma 1.5 with zeros around, float64."""
    window = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    window = np.outer(window, window) / window.sum() ** 2
    total = []
    for c in range(3):
        x, y = np.pad(a[..., c], 5), np.pad(b[..., c], 5)
        for i, j in np.ndindex(a.shape[:2]):
            u, v = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            mu, mv = (window * u).sum(), (window * v).sum()
            vu, vv, uv = (
                (window * p * q).sum() - m * n for p, q, m, n in ((u, u, mu, mu), (v, v, mv, mv), (u, v, mu, mv))
            )
            total.append((2 * mu * mv + 1e-4) * (2 * uv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (vu + vv + 9e-4)))
    return float(np.mean(total))


def test_g05_it_is_the_gaussian_window_of_the_papers(held):
    image, target = pair(14, 19)
    truth = by_the_book(image.double().numpy(), target.double().numpy())
    assert 0.1 < truth < 0.95
    held(abs(ssim(image, target).item() - truth), 2e-6)


def test_reference_gradient():
    image, target = (t.double() for t in pair(7, 6))
    torch.autograd.gradcheck(lambda x: ssim_reference(x, target), image.requires_grad_(), eps=1e-6, atol=1e-8)


@pytest.mark.parametrize("level", [0.0, 0.1, 0.6, 1.0, 100.0, 1000.0])
def test_g01_g03_flat_pictures(level, held):
    flat = torch.full((40, 30, 3), level, requires_grad=True)
    value = ssim(flat, flat.detach().clone())
    value.backward()
    held(abs(value.item() - 1), 1e-6)
    assert flat.grad.abs().max() < 1e-6


@pytest.mark.parametrize("brightest", [1.0, 100.0, 1000.0])
def test_g03_bright_pictures_stay_in_range_and_near_float64(brightest, held):
    image, target = (brightest * p for p in pair(40, 30))
    value, truth = ssim(image, target).item(), ssim_reference(image.double(), target.double()).item()
    assert -1 <= value <= 1 and truth < 0.95
    held(abs(value - truth), 2e-5)


def test_g01_flat_picture_against_texture_stays_in_range():
    _, target = pair(40, 30)
    value = ssim(torch.full_like(target, 0.5), target).item()
    assert -1 <= value < 0.9


def test_worse_pictures_score_lower():
    image, target = pair(64, 64)
    assert ssim(target, target).item() == pytest.approx(1, abs=1e-5)
    assert ssim(image, target) < ssim((image + target) / 2, target) < 1

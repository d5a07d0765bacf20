"""SSIM: the fused kernel against its specification, flat pictures, and what it must mean."""

import pytest
import torch

from stages.avatar.ssim import ssim, ssim_reference


def pair(height, width, seed=0):
    g = torch.Generator().manual_seed(seed)
    target = torch.nn.functional.interpolate(torch.rand(1, 3, 6, 6, generator=g), (height, width), mode="bilinear")
    target = target[0].permute(1, 2, 0).contiguous()
    return (target + 0.1 * torch.randn(height, width, 3, generator=g)).clamp(0, 1), target


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (45, 61), (128, 96)])
def test_g04_kernel_agrees_with_the_reference(size):
    image, target = pair(*size)
    image.requires_grad_()
    value = ssim(image, target)
    value.backward()
    true = image.detach().double().requires_grad_()
    expected = ssim_reference(true, target.double())
    expected.backward()
    assert abs(value.item() - expected.item()) < 2e-6
    assert (image.grad - true.grad).norm() <= 2e-5 * true.grad.norm()


def test_reference_gradient():
    image, target = (t.double() for t in pair(7, 6))
    torch.autograd.gradcheck(lambda x: ssim_reference(x, target), image.requires_grad_(), eps=1e-6, atol=1e-8)


@pytest.mark.parametrize("level", [0.0, 0.1, 0.6, 1.0])
def test_g01_flat_pictures(level):
    flat = torch.full((40, 30, 3), level, requires_grad=True)
    value = ssim(flat, flat.detach().clone())
    value.backward()
    assert value.item() == pytest.approx(1, abs=1e-6)
    assert flat.grad.abs().max() < 1e-6


def test_flat_picture_against_texture_stays_in_range():
    _, target = pair(40, 30)
    value = ssim(torch.full_like(target, 0.5), target).item()
    assert -1 <= value < 0.9


def test_worse_pictures_score_lower():
    image, target = pair(64, 64)
    assert ssim(target, target).item() == pytest.approx(1, abs=1e-5)
    assert ssim(image, target) < ssim((image + target) / 2, target) < 1

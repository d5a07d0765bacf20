"""PSNR, SSIM and LPIPS of whole pictures and of the person's crop."""

import math

import numpy as np
import pytest
import torch

from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import over_white, person_crop, psnr, psnr_per_channel, scores


def pictures(height=40, width=50):
    g = torch.Generator().manual_seed(0)
    return torch.rand(height, width, 3, generator=g), torch.rand(height, width, 3, generator=g)


def test_g14_psnr_of_known_errors():
    truth = torch.full((8, 8, 3), 0.5)
    assert float(psnr(truth + 0.1, truth)) == pytest.approx(20, abs=1e-4)
    assert math.isinf(float(psnr(truth, truth)))
    uneven = truth + torch.tensor([0.1, 0.1, 0.001])
    assert float(psnr(uneven, truth)) == pytest.approx(-10 * math.log10((0.01 + 0.01 + 1e-6) / 3), abs=1e-3)
    assert float(psnr_per_channel(uneven, truth)) == pytest.approx((20 + 20 + 60) / 3, abs=1e-2)


def test_crop_holds_the_person_and_no_more():
    mask = torch.zeros(40, 50)
    mask[10, 5], mask[19, 24], mask[0, 0] = 1, 0.6, 0.4
    rows, columns = person_crop(mask)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (10, 20, 5, 25)
    assert mask[rows, columns].shape == (10, 20)
    assert person_crop(torch.zeros(4, 4)) is None
    assert person_crop(torch.ones(4, 6)) == (slice(0, 4), slice(0, 6))


def test_over_white():
    image, _ = pictures()
    mask = torch.rand(40, 50)
    expected = image * mask[..., None] + (1 - mask[..., None])
    assert torch.allclose(over_white(image, mask), expected, atol=1e-6)
    assert torch.equal(over_white(image, torch.zeros(40, 50)), torch.ones(40, 50, 3))


def test_scores_of_equal_and_unequal_pictures():
    rng = np.random.default_rng(0)
    shapes = [(4, 3, 11, 11), (6, 4, 5, 5), (8, 6, 3, 3), (5, 8, 3, 3), (5, 5, 3, 3)]
    arrays = {f"conv{i}_w": rng.normal(size=shape) for i, shape in enumerate(shapes)}
    arrays |= {f"conv{i}_b": np.zeros(shape[0]) for i, shape in enumerate(shapes)}
    lpips = Lpips(arrays | {f"lin{i}": np.ones(shape[0]) for i, shape in enumerate(shapes)})
    image, truth = pictures(64, 70)
    same = scores(truth, truth, lpips)
    assert same["ssim"] == pytest.approx(1, abs=1e-5) and same["lpips"] == 0 and same["psnr"] == math.inf
    other = scores(image, truth, lpips)
    assert other["psnr"] < 10 and other["ssim"] < 0.3 and other["lpips"] > 0.1
    assert scores(image[:63], truth[:63], lpips)["lpips"] is None and scores(image, truth)["lpips"] is None

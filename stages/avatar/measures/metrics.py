"""How close a rendered picture is to the real one: PSNR, SSIM and LPIPS, whole or on the person."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.ssim import ssim


def psnr(image: Tensor, truth: Tensor) -> Tensor:
    """-10 log10 of the mean squared error over all pixels and channels, in dB; values in [0, 1], infinite if equal."""
    return -10 * (image - truth).square().mean().log10()


def psnr_per_channel(image: Tensor, truth: Tensor) -> Tensor:
    """Mean over the three channels of each one's PSNR in dB: what 3DGS and HUGS report; never below `psnr`."""
    return -10 * (image - truth).square().flatten(0, 1).mean(0).log10().mean()


def scores(image: Tensor, truth: Tensor, lpips: Lpips | None = None) -> dict[str, float | None]:
    """psnr, psnr_per_channel, ssim, lpips and lpips_legacy of pictures [H,W,3] in [0, 1].

    LPIPS is None without weights, and for pictures under `lpips.smallest` px.
    """
    perceptual = lpips if lpips is not None and min(image.shape[:2]) >= lpips.smallest else None
    with torch.no_grad():
        return {
            "psnr": float(psnr(image, truth)),
            "psnr_per_channel": float(psnr_per_channel(image, truth)),
            "ssim": float(ssim(image, truth)),
            "lpips": None if perceptual is None else float(perceptual(image, truth)),
            "lpips_legacy": None if perceptual is None else float(perceptual(image, truth, legacy=True)),
        }


def person_crop(mask: Tensor) -> tuple[slice, slice] | None:
    """Rows and columns of the tightest box around the person, mask [H,W] in [0, 1] above one half; None without one."""
    inside = mask > 0.5
    rows, columns = inside.any(1).nonzero().flatten(), inside.any(0).nonzero().flatten()
    if not len(rows):
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def over_white(image: Tensor, mask: Tensor) -> Tensor:
    """The picture [H,W,3] where the soft mask [H,W] is 1, white where it is 0."""
    return 1 - mask[..., None] * (1 - image)

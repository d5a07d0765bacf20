"""Accuracy of a training on frames that it does not learn from."""

from __future__ import annotations

from statistics import fmean

import torch

from stages.avatar.drawing.cast import Cast
from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import person_crop, scores
from stages.training.views import Views


@torch.no_grad()
def heldout_accuracy(
    cast: Cast, views: Views, frames: list[int], lpips: Lpips | None = None
) -> dict[str, float | None]:
    """Mean psnr, ssim and lpips of `frames`, which show the person, at full size; `*_person` in the person's box.

    None where there is no frame, or no `lpips`.
    """
    rows = []
    for i in frames:
        image, mask, moment = views.images[i].float() / 255, views.masks[i].float() / 255, cast.at(i)
        if not moment.sets:
            continue  # of several people: nothing to draw
        drawn = moment.draw(views.camera(i))[0].image
        drawn, crop = (drawn if views.gains is None else drawn * views.gains[i]).clamp(0, 1), person_crop(mask)
        if cast.scene is None:
            image = image * mask[..., None]
        whole, person = scores(drawn, image, lpips), scores(drawn[crop].contiguous(), image[crop].contiguous(), lpips)
        rows.append(whole | {f"{key}_person": value for key, value in person.items()})
    keys = [key + end for key in ("psnr", "ssim", "lpips") for end in ("", "_person")]
    found = {key: [value for row in rows if (value := row[key]) is not None] for key in keys}
    return {key: fmean(values) if values else None for key, values in found.items()}

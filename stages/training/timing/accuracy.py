"""Accuracy of a training on frames that it does not learn from."""

from __future__ import annotations

from statistics import fmean

import torch

from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import person_crop, scores
from stages.avatar.rasterize import Camera, Layer
from stages.avatar.splats.gaussians import together
from stages.training.step.fit import Fit


@torch.no_grad()
def heldout_accuracy(fit: Fit, frames: list[int], lpips: Lpips | None = None) -> dict[str, float | None]:
    """Mean psnr, ssim and lpips of `frames`, which show the person, at full size; `*_person` in the person's box.

    The person is as training has it, before `bake` finishes it. None where there is no frame, or no `lpips`.
    """
    rows, views, gains, viewmats = [], fit.full, fit.gains(), fit.cameras()
    people = [(who, fit.bodies(who), who.baked()[1]) for who in fit.people]
    scene = fit.scene.splats() if fit.scene else None
    for i in frames:
        image, mask = views.images[i].float() / 255, views.masks[i].float() / 255
        there = [one for one in people if one[0].shown(i)]
        if scene is None and not there:
            continue  # of several people: nothing to draw
        poses = [
            (who, (orient[i], body_pose[i], transl[i]), resting) for who, (orient, body_pose, transl), resting in there
        ]
        human = together([fit.posed(resting, *body, of=who) for who, body, resting in poses])
        lit = fit.effects.shade(scene, *(fit.stance(*body, of=who) for who, body, _ in poses))
        motion = fit.motion(i, [who for who, *_ in there], [resting for *_, resting in there])
        camera = Camera(viewmats[i], views.Ks[i], mask.shape[1], mask.shape[0])
        drawn = fit.effects.draw(human, lit, motion, camera, [Layer()])[0].image
        drawn, crop = (drawn * gains[i]).clamp(0, 1), person_crop(mask)
        if scene is None:
            image = image * mask[..., None]
        whole, person = scores(drawn, image, lpips), scores(drawn[crop].contiguous(), image[crop].contiguous(), lpips)
        rows.append(whole | {f"{key}_person": value for key, value in person.items()})
    keys = [key + end for key in ("psnr", "ssim", "lpips") for end in ("", "_person")]
    found = {key: [value for row in rows if (value := row[key]) is not None] for key in keys}
    return {key: fmean(values) if values else None for key, values in found.items()}

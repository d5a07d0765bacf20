"""Lets the colours that frames show well make up for those that finishing has changed."""

from __future__ import annotations

from itertools import cycle, islice

import torch
from torch import Tensor

from stages.avatar.model.person import Canonical, rest
from stages.avatar.rasterize import Camera, Layer
from stages.training import losses
from stages.training.company import Company
from stages.training.finishing.painted import EDGE
from stages.training.person import PersonLearner
from stages.training.views import person_box, person_frames

STEPS = 128  # a phone clip: 0.20 dB of the 0.25 that finishing costs, in 5 s
RATE = 0.04  # falling to 0; a quarter of it brings back half as much


def settle_colors(fit: Company, who: PersonLearner, person: Canonical, own: Tensor, frames: list[int]) -> Canonical:
    """The finished person with colours that draw the `frames` better; a colour moves as far as it is its own[N], 0 to 1.

    Nothing else moves. Pixels of other people are not compared; without a scene only those well inside the person's mask.
    """
    views, seen, gains, viewmats = fit.full, who.masked(fit.full), fit.gains().detach(), fit.cameras().detach()
    orient, body_pose, transl = (part.detach() for part in fit.bodies(who))
    scene = None if fit.scene is None else fit.scene.splats().detach()
    resting, share = rest(person, who.canonical_bones), own[:, None, None]
    change = torch.zeros_like(person.sh).requires_grad_()
    adam = torch.optim.Adam([change], eps=1e-15)
    for step, i in enumerate(islice(cycle(person_frames(who.body, seen, frames)), STEPS)):
        body = orient[i], body_pose[i], transl[i]
        posed = fit.posed(resting._replace(sh=person.sh + share * change), *body, of=who)
        with torch.no_grad():
            lit, motion = fit.effects.shade(scene, fit.stance(*body, of=who)), fit.motion(i, [who], [resting])
        image, mask, everybody = views.images[i].float() / 255, *(m[i].float() / 255 for m in (seen.masks, views.masks))
        left, top, right, bottom = box = person_box(mask, posed.means.detach(), viewmats[i], views.Ks[i])
        crop = slice(top, bottom), slice(left, right)
        camera = Camera(viewmats[i], views.Ks[i], mask.shape[1], mask.shape[0])
        drawn = fit.effects.draw(posed, lit, motion, camera, [Layer(window=box)])[0].image * gains[i]
        known = 1 - (everybody - mask) if scene is not None else -losses.dilated(-mask, EDGE)
        wanted, told = image[crop], known[crop][..., None]
        loss = losses.photometric(wanted + told * (drawn - wanted), wanted)
        (change.grad,) = torch.autograd.grad(loss, change)
        adam.param_groups[0]["lr"] = RATE * (1 - step / STEPS)
        adam.step()
    return person._replace(sh=person.sh + share * change.detach())

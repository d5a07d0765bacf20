"""Refines each Gaussian of the finished person without networks: undoes what finishing cost, adds detail beyond the networks."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle, islice
from typing import NamedTuple

import torch
from torch import Tensor

from stages.avatar.drawing.cast import Cast
from stages.avatar.effects.motion_blur import BlurredRendering
from stages.avatar.model.person import Canonical, Resting, rest
from stages.avatar.rasterize import Layer, Rendering
from stages.avatar.splats.neighbours import nearest
from stages.training.finishing.bake import Known
from stages.training.step import losses
from stages.training.step.person import Learning
from stages.training.views import Views, person_box, person_frames

STEPS, SHARE = 256, 0.25  # at most; of the steps of training
RATES = {"sh": 0.03, "opacity": 0.1, "size": 0.02, "place": 4e-4}  # falling to 0
ALONE = 0.5  # weight of the person alone, beside that of person and scene together
DOUBLE = 0.7  # log of the factor by which a size changes at most
EVEN, NEIGHBOURS = 0.1, 6  # weight of the difference of colours that frames see aslant from those of so many neighbours
SEAM = 0.1  # difference of colours [SH] from which on its cost grows no faster: seams stay


class Change(NamedTuple):
    """How N Gaussians change: sh[N,K,3], opacity[N] logit, size[N,3] log, and place[N,3] m along their own axes."""

    sh: Tensor
    opacity: Tensor
    size: Tensor
    place: Tensor

    def held(self, own: Tensor, told: Tensor) -> Change:
        """As much of it as colours are their own[N] and frames have told[N,3] of each axis, both from 0 to 1."""
        size = DOUBLE * torch.tanh(self.size / DOUBLE)
        return Change(own[:, None, None] * self.sh, own * self.opacity, told * size, told * self.place)

    def opaque(self, opacities: Tensor) -> Tensor:
        """Opacities [N], 0 and 1 too, with their logits changed."""
        odds = opacities * self.opacity.exp()
        return odds / (odds + (1 - opacities))

    def at_rest(self, resting: Resting, scales: Tensor) -> Resting:
        """Somebody at rest, whose scales[N,3] m these are, changed."""
        means = resting.means + (resting.axes @ (self.place / scales)[..., None])[..., 0]
        axes, opacities = resting.axes * self.size.exp()[:, None, :], self.opaque(resting.opacities)
        return resting._replace(means=means, axes=axes, opacities=opacities, sh=resting.sh + self.sh)

    def of(self, person: Canonical) -> Canonical:
        """The person, changed."""
        return person._replace(
            means=person.means + (person.rotations @ self.place[..., None])[..., 0],
            scales=person.scales * self.size.exp(),
            opacities=self.opaque(person.opacities),
            sh=person.sh + self.sh,
        )


def settle(
    who: Learning,
    person: Canonical,
    known: Known,
    frames: list[int],
    cast: Cast,
    views: Views,
    human_loss: bool,
    taken: int,
) -> Canonical:
    """The finished `person`, changed as far as they are `known` to draw `frames` better, with and without the scene.

    Poses, bones and scene stay. Pixels of other people are not compared. Without `human_loss` only both together are drawn.
    `taken`: the steps of the training, of which settling takes SHARE.
    """
    steps = min(STEPS, round(SHARE * taken))
    learner, scales = who.who, person.scales
    seen, resting = learner.masked(views), learner.body.gloved(rest(person, learner.canonical_bones))
    mien = learner.body.mien(resting)
    first = person.sh, person.opacities, scales, person.means
    change = Change(*(torch.zeros_like(part).requires_grad_() for part in first))
    adam = torch.optim.Adam([{"params": [part], "name": name} for name, part in change._asdict().items()], eps=1e-15)
    near = nearest(person.means, person.means, NEIGHBOURS + 1)[1][:, 1:]
    generator = torch.Generator().manual_seed(0)
    row = torch.arange(len(person.means) + (0 if cast.scene is None else len(cast.scene.means)), device=scales.device)
    for step, i in enumerate(islice(cycle(person_frames(learner.body, seen, frames)), steps)):
        held = change.held(known.own, known.told)
        moment = cast.at(i, [replace(who, resting=held.at_rest(resting, scales), mien=mien)])
        image, mask, everybody = views.images[i].float() / 255, *(m[i].float() / 255 for m in (seen.masks, views.masks))
        camera = views.camera(i)
        left, top, right, bottom = box = person_box(mask, moment.people[0].means.detach(), camera.viewmat, camera.K)
        crop = slice(top, bottom), slice(left, right)
        background = torch.rand(3, generator=generator).to(image)
        layers = {"person": Layer(row < len(person.means), box, background), "all": Layer(window=box)}
        if cast.scene is None:
            del layers["all"]
        elif not human_loss:
            del layers["person"]
        pictures = moment.draw(camera, list(layers.values()))
        drawn: dict[str, Rendering | BlurredRendering] = dict(zip(layers, pictures))
        gains = torch.ones_like(background) if views.gains is None else views.gains[i]
        clear, target = 1 - (everybody - mask)[crop], (image[crop], mask[crop], background)
        loss = EVEN * uneven(person.sh + held.sh, near, known.aslant)
        if "person" in drawn:
            alone = drawn["person"].image, drawn["person"].alpha
            shown = losses.compared(*alone, gains, clear, cast.effects.blurs, target)
            loss = loss + ALONE * losses.person_only(*shown, *target)
        if "all" in drawn:
            off = clear[..., None] * (drawn["all"].image * gains - image[crop])
            loss = loss + losses.photometric(image[crop] + off, image[crop])
        slopes = Change(*torch.autograd.grad(loss, change))
        learner.guard.contain(f"settling of {learner.name}", slopes._asdict())
        for part, slope in zip(change, slopes, strict=True):
            part.grad = slope
        for group in adam.param_groups:
            group["lr"] = RATES[group["name"]] * (1 - step / steps)
        adam.step()
    with torch.no_grad():
        return change.held(known.own, known.told).of(person)


def uneven(sh: Tensor, near: Tensor, aslant: Tensor) -> Tensor:
    """How far colours sh[N,K,3] are from those of their neighbours near[N,M] in the mean, each counted by aslant[N].

    Frames that look along a surface see many Gaussians in one pixel, and tell their sum: of one that is too light and one that is
    too dark, the light one shows from elsewhere. The neighbours carry no gradient.
    """
    apart = (sh[:, None] - sh.detach()[near]).square().sum((2, 3))
    return (aslant[:, None] * ((apart + SEAM**2).sqrt() - SEAM)).mean()

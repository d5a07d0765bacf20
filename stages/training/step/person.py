"""How the person learns: the networks decoded once for several frames, which share their gradients; corrections of each
Gaussian's own with every frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.optim import Optimizer

from stages.avatar.body.skinning import knn_weights
from stages.avatar.drawing.avatar import Mien
from stages.avatar.effects.shadow import Casters
from stages.avatar.kernels.products import products, turned
from stages.avatar.model.decoders import OWN
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import Canonical, Resting, bone_transforms, rest, taken_back
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import nearest
from stages.training.seen import as_body_where_unseen
from stages.training.step import losses
from stages.training.step.guard import Guard
from stages.training.step.outlines import Outline
from stages.training.step.refine import BodyCorrections
from stages.training.views import FittedBody, Poses, Views

NEIGHBOURS = 8  # a surface Gaussian is held at their mean height
MOVED = 0.005  # metres after which a Gaussian looks for its neighbours on the body again


class Starting(NamedTuple):
    """A person before training: their fitted body, model and outline; without an outline they are alone."""

    body: FittedBody
    human: HumanModel
    outline: Outline | None = None


class PersonLearner:
    """Person `number`, from 1 on, of a clip: their fitted `body`, their model `human` and the `corrections` of their poses.

    `outline` has their masks among several people, None: they are alone. `name` is theirs among the sets of Gaussians.

    `leaves` is what the networks give, `Shared` but at rest, with the `rotations` to there: tensors that collect gradients, None
    until they are decoded again. `color_grad_sum` [N] sums the gradients of each Gaussian's colour: what stays at 0 no
    frame has shown. `pull` is what the frame that is drawn pays for corrections.
    """

    def __init__(self, one: Starting, guard: Guard, number: int = 1):
        self.body, self.human, self.guard, self.number = one.body, one.human, guard, number
        self.name = f"person {number}"
        self.outline, self.small = one.outline, one.outline and one.outline.half()
        shapes = len(self.body.face.shapes) if self.body.face is not None and self.body.learns_face else 0
        corrections = BodyCorrections(len(self.body.transl), self.body.own_bones, shapes)
        self.corrections = corrections.to(self.body.vertices)
        self.canonical_bones = self.body.canonical_bones()
        self.surface, _, self.surface_weights = self.body.surface()
        self.leaves: dict[str, Tensor] | None = None
        self.pull = torch.zeros(())
        self.near: Tensor | None = None
        self.reference, self.reference_at = torch.zeros(0, 24), torch.zeros(0, 3)
        self.color_grad_sum = torch.zeros(len(self.human)).to(self.body.vertices)

    @cached_property
    def casters(self) -> Casters:
        """What casts the person's shadow, at rest."""
        return self.body.casters()

    @torch.no_grad()
    def casters_in(self, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Casters:
        """What casts the person's shadow in a pose [3], [69], [3], in the world."""
        bones = bone_transforms(self.body.joints, self.body.parents, global_orient, body_pose)
        return self.casters.posed(bones, transl)

    def mask(self, views: Views, frame: int) -> Tensor:
        """Their mask uint8 [H,W] in a frame of `views`, whole or half."""
        outline = self._outline(views)
        return (views if outline is None else outline).masks[frame]

    def seen(self, views: Views, frame: int) -> tuple[Tensor, Tensor | None]:
        """Their mask [H,W] in 0..1 in a frame of `views`, whole or half, and 1 where the frame tells of them; None: all."""
        outline = self._outline(views)
        known = None if outline is None else (outline.hidden[frame] == 0).float()
        return self.mask(views, frame).float() / 255, known

    def _outline(self, views: Views) -> Outline | None:
        whole = self.outline is None or views.masks.shape == self.outline.masks.shape
        return self.outline if whole else self.small

    def shown(self, frame: int) -> bool:
        """Whether a frame shows this one of several people, and a fit tells how they stand there; one who is alone always."""
        if self.outline is None:
            return True
        return bool(self.body.confidence[frame] > 0 and (self.outline.masks[frame] > 127).any())

    def masked(self, views: Views) -> Views:
        """The `views` of whole size with the masks of this person alone."""
        return views if self.outline is None else views._replace(masks=self.outline.masks)

    def resting(self, learn: bool = True) -> Resting:
        """The person at rest for one frame: of leaves that collect gradients until the next `learn`, and what is theirs now.

        Without `learn` the leaves collect none.
        """
        leaves = self._decoded() if learn else {name: leaf.detach() for name, leaf in self._decoded().items()}
        rotations, scales, opacities, sh, changed = self.human.look(*(leaves[name] for name in OWN))
        self.pull, axes = losses.REGULAR * changed, products(leaves["rotations"], rotations * scales[:, None, :])
        weights = leaves["weights"] if self.gloves is None else self.gloves.weights(leaves["weights"])
        return Resting(leaves["means"], axes, opacities, sh, weights, leaves["rotations"], self.normals)

    def _decoded(self) -> dict[str, Tensor]:
        if self.leaves is None:
            shared, outside_box, moved = self.human.shared()
            rough = losses.roughness(shared.means, self._neighbours(), self.human.normals)
            self.prior = losses.OUTSIDE * outside_box + losses.REGULAR * moved + losses.SMOOTH * rough
            means, rotations = taken_back(shared.means, shared.weights, self.canonical_bones)
            self.normals = turned(rotations.detach(), self.human.normals)
            hands = self.body.hands
            self.gloves = None if hands is None else hands.gloves(means.detach(), shared.weights.detach())
            self.mien = None if self.body.face is None else self.body.face.at(means.detach(), shared.weights.detach())
            self.shared, self.decoded = shared, shared._asdict() | {"means": means, "rotations": rotations}
            # those of OWN also without networks, for `color_grad_sum`
            taught = {name: t.requires_grad or name in OWN for name, t in self.decoded.items()}
            self.leaves = {name: t.detach().requires_grad_(taught[name]) for name, t in self.decoded.items()}
        return self.leaves

    def learn_own(self, optimizer: Optimizer) -> None:
        """Take one step of the Gaussians' own corrections with the gradients of a frame."""
        own = {name: getattr(self.human.residuals, name).grad for name in OWN}
        self.guard.contain(f"corrections of {self.name}", own)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def learn(self, optimizer: Optimizer, frames: int) -> None:
        """Take one step of the networks with what the leaves collected from so many frames, if any."""
        leaves, self.leaves = self.leaves, None
        if leaves is None or leaves["means"].grad is None:
            return
        collected = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
        self.guard.contain(self.name, collected)
        self.color_grad_sum += collected["sh"].abs().sum((1, 2))
        prior = self.prior
        if self.shared.weights.requires_grad:
            prior = losses.skinning(self.shared.weights, self._reference()) + prior
        slopes = {name: grad / frames for name, grad in collected.items() if self.decoded[name].requires_grad}
        decoded = [self.decoded[name] for name in slopes]
        torch.autograd.backward([*decoded, prior], [*slopes.values(), torch.ones_like(prior)])
        rows = {name: getattr(owner, name) for owner, name in self.human.rows()}
        self.guard.contain(f"places of {self.name}", {name: p.grad for name, p in rows.items() if p.grad is not None})
        by_row = {id(p) for p in rows.values()}
        shared = [p.grad for p in self.human.parameters() if id(p) not in by_row and p.grad is not None]
        if self.guard.clip(f"networks of {self.name}", shared):
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def _neighbours(self) -> Tensor:
        """Rows [N,NEIGHBOURS] of the Gaussians that began nearest to each."""
        homes = self.human.homes
        if self.near is None or len(self.near) != len(homes):
            self.near = nearest(homes, homes, NEIGHBOURS + 1)[1][:, 1:]  # without itself
        return self.near

    def _reference(self) -> Tensor:
        """Skinning weights [N,24] of the nearest body vertices, looked up again only for Gaussians that moved."""
        at = self.shared.means.detach()
        if len(self.reference) != len(at):
            self.reference_at = torch.full_like(at, math.inf)
            self.reference = torch.zeros_like(self.shared.weights.detach())
        moved = ~((at - self.reference_at).norm(dim=1) < MOVED)
        if moved.any():
            self.reference[moved] = knn_weights(at[moved], self.surface, self.surface_weights)
            self.reference_at[moved] = at[moved]
        return self.reference

    def follow(self, source: Tensor) -> None:
        """After a densification: `source` [M] is the old row of each Gaussian."""
        self.color_grad_sum = self.color_grad_sum[source]
        self.leaves = self.near = None

    @torch.no_grad()
    def baked(self) -> tuple[Canonical, Resting]:
        """The person to keep as of now, in the canonical and in the rest pose, without gradients; `bake` finishes it."""
        canonical = as_body_where_unseen(self.human()[0], self.human.initial(), self.color_grad_sum)
        return canonical, rest(canonical, self.canonical_bones)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        leaves = {} if self.leaves is None else self.leaves
        return {
            "reference": [self.reference.clone(), self.reference_at.clone()],
            "color_grad_sum": self.color_grad_sum.clone(),
            "leaves": {n: leaf.grad.clone() for n, leaf in leaves.items() if leaf.grad is not None},
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from `state()`; the model is already as it was."""
        self.reference, self.reference_at = (t.clone() for t in state["reference"])
        self.color_grad_sum = state["color_grad_sum"].clone()
        self.leaves = self.near = None
        for name, grad in state["leaves"].items():
            self._decoded()[name].grad = grad.clone()


@dataclass(frozen=True)
class Learning:
    """A `Performer`: somebody who learns, as they are `resting`, in the poses of frames.

    `swings`: clothes swing as corrected in the frame, else as the pose makes them; not `clothed`: they follow the skeleton.
    `mien`: their face, None where it stays still.
    """

    who: PersonLearner
    resting: Resting
    pose: Callable[[int], Poses]
    antialias: bool
    clothed: bool
    swings: bool = False
    mien: Mien | None = None

    def shown(self, frame: int) -> bool:
        """Whether the frame shows the person."""
        return self.who.shown(frame)

    def splats(self, frame: int) -> Splats:
        """The person's Gaussians in the world, in even light."""
        return self._posed(frame, self.swings)

    def casters(self, frame: int) -> Casters:
        """What casts the person's shadow, in the world."""
        return self.who.casters_in(*self.pose(frame)[:3])

    def means(self, frame: int) -> Tensor | None:
        """Means [N,3] m of the Gaussians; None where no fit shows how they stand."""
        return self._posed(frame, False).means if self.who.body.confidence[frame] > 0 else None

    def _posed(self, frame: int, swings: bool) -> Splats:
        body, (orient, body_pose, transl, face), resting = self.who.body, self.pose(frame), self.resting
        if self.mien is not None and face is not None:
            resting = resting._replace(means=self.mien.moved(resting.means, face))
        bones = bone_transforms(body.joints, body.parents, orient, body_pose)
        if body.clothing is not None:
            swing = body.clothing.swing(body_pose) if self.clothed else None
            bones = body.clothing.hang(bones, self.who.corrections.swing_of(frame if swings else None, swing))
        return body.placed(resting, bones, transl, frame)._replace(antialias=self.antialias)

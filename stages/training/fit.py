"""One joint optimisation of person and scene: what happens in a step, and all that a checkpoint must hold."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.skinning import knn_weights
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shadow import Stance
from stages.avatar.effects.speeds import FrameMotion, Speeds
from stages.avatar.measures.lpips import Lpips
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import Canonical, Resting, bone_transforms, pose, rest
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import nearest
from stages.training import losses
from stages.training.checkpoint import snapshot
from stages.training.clock import Clock
from stages.training.densify import Growth, Rules, grow_human, grow_scene
from stages.training.finishing.bake import as_body_where_unseen
from stages.training.finishing.behind import fill_behind
from stages.training.guard import Guard
from stages.training.layers import layers_of
from stages.training.optimizers import optimizers
from stages.training.refine import FrameCorrections
from stages.training.schedule import HUMAN_GROWTH, SCENE_GROWTH, SETTLE, Options, Phase, phases, rate
from stages.training.transients import Transients
from stages.training.views import Person, Views

NEIGHBOURS = 8  # of which a Gaussian of the surface is the middle
GROWN = 2e-4  # mean absolute gradient, in loss per half image side, from which a Gaussian is under-fitted
FILLS = 10  # at most; each at most doubles a set
MOVED = 0.005  # metres after which a Gaussian looks for its neighbours on the body again


class Fit:
    """State of one training run. `train` lists the frames that may be learned from; no other is looked at."""

    def __init__(
        self,
        views: Views,
        train: list[int],
        person: Person | None,
        human: HumanModel | None,
        scene: SceneModel | None,
        options: Options,
        generator: torch.Generator,
        perceptual: Lpips | None = None,
        effects: FrameEffects | None = None,
        transients: Transients | None = None,
    ):
        self.full, self.small = views, views.half()
        self.train, self.person, self.human, self.scene = train, person, human, scene
        self.options, self.generator, self.perceptual = options, generator, perceptual
        self.phases = phases(options.steps, options.joint)
        self.frames = FrameCorrections(len(views.images)).to(views.viewmats)
        self.trained = torch.zeros(len(views.images), dtype=torch.bool)
        self.trained[train] = True
        self.effects = (effects or FrameEffects()).to(views.viewmats)
        self.transients = transients
        self.speeds = self._speeds() if self.effects.takes_time else None
        self.step, self.frame, self.undrawn = 0, train[0], 0
        self.guard, self.clock = Guard(), Clock()
        self.order = torch.empty(0, dtype=torch.long)
        self.before: dict[str, Any] | None = None
        self.leaves: Resting | None = None
        self.near: Tensor | None = None
        self.behind: Tensor | None = None
        if person is not None:
            self.canonical_bones = person.canonical_bones()
        self.reference, self.reference_at = torch.zeros(0, 24), torch.zeros(0, 3)
        self.taught = torch.zeros(0 if human is None else len(human)).to(views.viewmats)
        self.adam = optimizers(self.frames, human, scene, options.extent, self.effects)
        self.growth = {n: Growth(len(m), views.viewmats.device) for n, m in self._sets().items()}

    def sizes(self) -> dict[str, int]:
        """How many Gaussians there are now, of each set."""
        return {"human": len(self.human) if self.human else 0, "scene": len(self.scene) if self.scene else 0}

    def _sets(self) -> dict[str, Any]:
        return {n: m for n, m in (("human", self.human), ("scene", self.scene)) if m is not None}

    def modules(self) -> dict[str, torch.nn.Module]:
        """All that has parameters, by name."""
        found = self._sets() | {"frames": self.frames, "effects": self.effects}
        return found if self.transients is None else found | {"transients": self.transients}

    def _speeds(self) -> Speeds:
        views, count = self.full, len(self.full.images)
        moments = np.arange(count) if views.moments is None else views.moments.cpu().numpy()
        known = np.ones(count, bool) if self.person is None else (self.person.confidence > 0).cpu().numpy()
        return Speeds(views.viewmats.cpu().numpy(), views.Ks, views.images.shape[1], moments, known)

    # ---- one step ----

    @property
    def phase(self) -> Phase:
        """The phase of the next step."""
        return next(phase for phase in reversed(self.phases) if phase.first <= self.step)

    @property
    def done(self) -> float:
        """Share of the phase's schedule behind us."""
        return self.phase.done(self.step)

    @property
    def share(self) -> float:
        """Share of the whole run behind us, each phase counted the same."""
        return (self.phases.index(self.phase) + self.done) / len(self.phases)

    @property
    def total(self) -> int:
        """Steps of the whole run."""
        return self.phases[-1].first + self.phases[-1].steps

    def retime(self, left: int) -> None:
        """Let `left` > 0 more steps finish the schedule of the last phase, from where it is."""
        *before, last = self.phases
        self.phases = (*before, last._replace(first=self.step, steps=left, start=last.done(self.step)))

    def advance(self) -> dict[str, float]:
        """Learn from one training frame; returns the losses.

        FloatingPointError after too many bad steps in a row, ValueError when no Gaussian is left; `before` is then the
        snapshot from which this step fails again.
        """
        self.clock.start()
        self.before = copy.deepcopy(snapshot(self)) if self.guard.alarmed else None
        self._grow()
        self._settle()
        self.clock.lap("growth")
        self.frame = self._next_frame()
        self._rates()
        views = self.small if self.done < self.options.half_until else self.full
        numbers = self._learn(self.frame, views)
        self.step += 1
        if self.human is not None and (self.step % self.options.views_per_decode == 0 or self.step == self.total):
            self._learn_human()
            self.clock.lap("person's networks")
        return numbers

    def _next_frame(self) -> int:
        if len(self.order) == 0:
            self.order = torch.randperm(len(self.train), generator=self.generator)
        frame, self.order = self.train[int(self.order[0])], self.order[1:]
        return frame

    def _rates(self) -> None:
        for optimizer in self.adam.values():
            for group in optimizer.param_groups:
                group["lr"] = group["base"] * rate(group["name"], self.done)

    def _decode(self) -> tuple[Canonical, Resting, Tensor]:
        canonical, stray, shy = self.human()
        rough = losses.roughness(canonical.means, self._neighbours(), self.human.rotations[:, :, 2])
        prior = losses.STRAY * stray + losses.SHY * shy + losses.SMOOTH * rough
        return canonical, rest(canonical, self.canonical_bones), prior

    def resting(self) -> Resting:
        """The decoded person as leaves that collect gradients until the next `_learn_human`."""
        if self.leaves is None:
            self.canonical, self.decoded, self.prior = self._decode()
            self.leaves = Resting(*(t.detach().requires_grad_(t.requires_grad) for t in self.decoded))
        return self.leaves

    def posed(self, resting: Resting, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Splats:
        """The person in the world at one pose."""
        p = self.person
        dressed = self.effects.clothe(resting, body_pose)
        splats = pose(dressed, bone_transforms(p.joints, p.parents, global_orient, body_pose), transl)
        return splats._replace(antialias=self.options.antialias)

    def _drawn(self, frame: int, mask: Tensor) -> bool:
        """Whether the person is drawn at a frame: mask[H,W] in 0..1 shows them, and their pose there is trusted at all."""
        there = self.human is not None and self.phase.human and bool(self.person.confidence[frame] > 0)
        return there and bool((mask > 0.5).any())

    def _learn(self, frame: int, views: Views) -> dict[str, float]:
        image, mask = views.images[frame].float() / 255, views.masks[frame].float() / 255
        viewmat, K = self._camera(frame), views.Ks[frame]
        height, width = mask.shape
        gains = self.frames.gains(frame) if self.options.exposure else None
        human, stance, scene, numbers, loss = None, None, None, {}, 0.0
        p, phase = self.person, self.phase
        trust = 0.0 if p is None else p.confidence[frame]  # a doubtful pose teaches little
        if self._drawn(frame, mask):
            self.clock.start()
            resting = self.resting()
            self.clock.lap("person's networks")
            body = self.body(frame)
            human, stance = self.posed(resting, *body), Stance(p.joints, p.parents, *body)
        if self.scene is not None and (phase.scene or human is not None):
            scene = self.scene.splats()
            if not phase.scene:
                scene = scene.detach()
        layers = layers_of(human, scene, mask, viewmat, K, self.options, self.generator)
        if not layers:
            return numbers
        motion = self.motion(frame, None if human is None else self.resting())
        lit = self.effects.shade(scene, stance)
        pictures = self.effects.draw(human, lit, motion, Camera(viewmat, K, width, height), list(layers.values()))
        drawn = dict(zip(layers, pictures))
        self.clock.lap("drawing")
        if scene is not None:
            rendered = drawn["all"].image if gains is None else drawn["all"].image * gains
            if self.options.human_loss or human is None:
                rendered = losses.outside_person(rendered, image, mask)
            if self.transients is not None:
                rendered = self.transients.replace(rendered, drawn["all"], image, frame, self.done)
            joint = losses.photometric(rendered, image)
            loss = loss + joint
            numbers["image"] = joint.item()
        if "person" in layers:
            only, layer = drawn["person"], layers["person"]
            (left, top, right, bottom), background = layer.window, layer.background
            bare = (1 - only.alpha)[..., None] * background
            rendered = only.image if gains is None else bare + gains * (only.image - bare)
            crop = (slice(top, bottom), slice(left, right))
            target = image[crop], mask[crop], background
            if self.effects.blurs:
                rendered = losses.unmixed(rendered, *target)
            apart = losses.person_only(rendered, only.alpha, *target)
            loss = loss + trust * apart
            numbers["person"] = apart.item()
        if "veil" in layers:
            left, top, right, bottom = layers["veil"].window
            loss = loss + losses.VEIL * (drawn["veil"].alpha * mask[top:bottom, left:right]).mean()
        self.clock.lap("losses")
        if "person" in layers and self.perceptual and self.step % self.options.perceptual_every == 0:
            window = losses.patch(mask[crop], losses.PATCH, self.generator)
            patch = losses.over_background(*target)[window]
            if min(patch.shape[:2]) >= self.perceptual.smallest:
                loss = loss + trust * losses.PERCEPTUAL * self.perceptual(rendered[window], patch)
            self.clock.lap("perceptual loss")
        loss = loss + self.effects.prior()
        self.undrawn += next(iter(drawn.values())).dropped
        finite = math.isfinite(loss.item())
        self.guard.left_out += not finite
        self.guard.judge("loss", not finite, f"{numbers}")
        if not finite:
            return numbers
        loss.backward()
        self.clock.lap("backward")
        rows = 0 if human is None else len(human.means)
        if scene is not None and phase.scene:
            self.growth["scene"].add(drawn["all"].screen_grad_abs[rows:], drawn["all"].radii[rows:], width, height)
            if self.behind is not None:
                for colors in self.scene.colors():
                    colors.grad[self.behind] = 0
            self.scene.add_sparsity_gradient(losses.FRUGAL)
            self._apply("scene")
            self.scene.clamp_opacities()
        if "person" in layers:
            self.growth["human"].add(only.screen_grad_abs[:rows], only.radii[:rows], right - left, bottom - top)
        elif human is not None:
            self.growth["human"].add(drawn["all"].screen_grad_abs[:rows], drawn["all"].radii[:rows], width, height)
        self._apply("frames")
        self._learn_effects()
        self.clock.lap("optimiser")
        return numbers

    def _camera(self, frame: int) -> Tensor:
        viewmat = self.full.viewmats[frame]
        return self.frames.camera(frame, viewmat, self.trained) if self.options.refine_camera else viewmat

    def motion(self, frame: int, resting: Resting | None) -> FrameMotion | None:
        """How everything moves at a frame, where an effect needs to know it; None for `resting`: nobody is drawn."""
        if self.speeds is None:
            return None
        return self.speeds.at(frame, resting and (lambda i: self.posed(resting, *self.body(i)).means))

    def body(self, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """global_orient[3], body_pose[69] and transl[3] of a frame, corrected where poses are refined."""
        p = self.person
        body = (p.global_orient[frame], p.body_pose[frame], p.transl[frame])
        return self.frames.body(frame, *body) if self.options.refine_pose else body

    def _learn_effects(self) -> None:
        if "effects" in self.adam:
            grads = [p.grad for p in self.effects.parameters() if p.grad is not None]
            if grads and self.guard.clip("effects", grads):
                self.adam["effects"].step()
                self.effects.clamp_times()
            self.adam["effects"].zero_grad(set_to_none=True)

    def _apply(self, name: str) -> None:
        """One step of an optimiser whose parameters have one row a Gaussian, or sparse ones of one row a frame."""
        optimizer = self.adam[name]
        grads = {g["name"]: g["params"][0].grad for g in optimizer.param_groups}
        rows = {n: g._values() if g.is_sparse else g for n, g in grads.items() if g is not None}
        if rows:
            self.guard.contain(name, rows)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def _learn_human(self) -> None:
        if self.leaves is None or self.leaves.means.grad is None:
            self.leaves = None
            return
        taught = {n: leaf.grad for n, leaf in self.leaves._asdict().items() if leaf.grad is not None}
        self.guard.contain("person", taught)
        self.taught += self.leaves.sh.grad.abs().sum((1, 2))
        prior = self.prior
        if self.canonical.weights.requires_grad:
            prior = losses.skinning(self.canonical.weights, self._reference()) + prior
        decoded = [getattr(self.decoded, n) for n in taught]
        drawn = self.step % self.options.views_per_decode or self.options.views_per_decode
        slopes = [grad / drawn for grad in taught.values()]
        torch.autograd.backward([*decoded, prior], [*slopes, torch.ones_like(prior)])
        rows = {name: getattr(owner, name) for owner, name in self.human.rows()}
        self.guard.contain("corrections", {name: p.grad for name, p in rows.items() if p.grad is not None})
        own = {id(p) for p in rows.values()}
        if self.guard.clip("networks", [p.grad for p in self.human.parameters() if id(p) not in own]):
            self.adam["human"].step()
        self.adam["human"].zero_grad(set_to_none=True)
        self.leaves = None

    def _neighbours(self) -> Tensor:
        """Rows [N,NEIGHBOURS] of the Gaussians that began nearest to each."""
        homes = self.human.homes
        if self.near is None or len(self.near) != len(homes):
            self.near = nearest(homes, homes, NEIGHBOURS + 1)[1][:, 1:]  # without itself
        return self.near

    def _reference(self) -> Tensor:
        """Skinning weights [N,24] of the nearest body vertices, looked up again only for Gaussians that moved."""
        at = self.canonical.means.detach()
        if len(self.reference) != len(at):
            self.reference_at = torch.full_like(at, math.inf)
            self.reference = torch.zeros_like(self.canonical.weights.detach())
        moved = ~((at - self.reference_at).norm(dim=1) < MOVED)
        if moved.any():
            self.reference[moved] = knn_weights(at[moved], self.person.vertices, self.person.weights)
            self.reference_at[moved] = at[moved]
        return self.reference

    # ---- growth ----

    def _grow(self) -> None:
        o, phase = self.options, self.phase
        every = max(1, round(phase.whole * (SETTLE - SCENE_GROWTH[0]) / o.growth_rounds))
        if (
            self.scene is not None
            and phase.scene
            and SCENE_GROWTH[0] <= self.done <= SCENE_GROWTH[1]
            and self.step % every == 0
        ):
            self._grow_scene(GROWN, self._left(every))
        every = 3 * every // o.views_per_decode * o.views_per_decode or o.views_per_decode
        grows = self.human is not None and phase.human and o.human_densify
        if grows and HUMAN_GROWTH[0] <= self.done <= HUMAN_GROWTH[1] and self.step % every == 0:
            self._grow_human(GROWN, self._left(every))

    def _grow_scene(self, grad: float, rounds_left: int) -> None:
        extent = self.options.extent
        rules = Rules(grad, 0.01 * extent, 0.5 * extent, 0.3, 0.005, self.options.scene_cap)
        grow_scene(self.scene, self.adam["scene"], self.growth["scene"], rules, rounds_left, self.generator)
        self.behind = None

    def _grow_human(self, grad: float, rounds_left: int) -> None:
        rules = Rules(grad, 0.01, 0.1, 0.3, 0.005, self.options.human_cap)
        state = self.adam["human"], self.growth["human"]
        rows = grow_human(self.human, *state, rules, rounds_left, self.person.vertices, self.generator)
        self.taught = self.taught[rows.source]
        self.leaves = self.near = None

    def fill_up(self) -> None:
        """Bring every set that may grow to its cap at once, as it would be after densification."""
        for _ in range(FILLS):
            before = self.sizes()
            if self.scene is not None:
                self._grow_scene(0.0, 1)
            if self.human is not None and self.options.human_densify:
                self._grow_human(0.0, 1)
            if self.sizes() == before:
                return

    def _settle(self) -> None:
        """Once growth is over: what the person hides or shades of the scene has its last colours."""
        if self.scene is None or self.behind is not None or not self.phase.scene or self.done <= SETTLE:
            return
        self.behind = fill_behind(self.scene, self.full._replace(viewmats=self.cameras()), self.train, self._dark)
        for colors in self.scene.colors():
            self.adam["scene"].state[colors]["exp_avg"][self.behind] = 0

    def _dark(self, frame: int) -> Tensor:
        """How deep each Gaussian of the scene is in the person's shadow at a frame, see `FrameEffects.shadow_depth`."""
        p, there = self.person, self._drawn(frame, self.full.masks[frame] / 255)
        stance = Stance(p.joints, p.parents, *self.body(frame)) if there else None
        return self.effects.shadow_depth(self.scene.means.detach(), stance)

    def _left(self, every: int) -> int:
        """Densifications still to come, this one included: the room up to the cap is shared out among them."""
        phase = self.phase
        return int((phase.first + (SETTLE - phase.start) * phase.whole - self.step) // every) + 1

    # ---- what comes out ----

    @torch.no_grad()
    def baked(self) -> tuple[Canonical, Resting]:
        """The person to keep as of now, in the canonical and in the rest pose, without gradients; `bake` finishes it."""
        canonical = as_body_where_unseen(self._decode()[0], self.human.initial(), self.taught)
        return canonical, rest(canonical, self.canonical_bones)

    def bodies(self) -> tuple[Tensor, Tensor, Tensor]:
        """Corrected global_orient[F,3], body_pose[F,69], transl[F,3]; untrained frames take their neighbours' correction."""
        if not self.options.refine_pose:
            return self.person.global_orient, self.person.body_pose, self.person.transl
        return self.frames.bodies(self.person, self.trained, self.full.moments)

    def gains(self) -> Tensor:
        """Exposure factors [F,3], of geometric mean 1 over the training frames."""
        if not self.options.exposure:
            return torch.ones_like(self.frames.gain.weight)
        return self.frames.all_gains(self.trained, self.full.moments)

    def cameras(self) -> Tensor:
        """Corrected viewmats [F,4,4], of mean correction 0 over the training frames."""
        if not self.options.refine_camera:
            return self.full.viewmats
        return self.frames.cameras(self.full.viewmats, self.trained, self.full.moments)

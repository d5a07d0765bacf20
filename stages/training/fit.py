"""One joint optimisation of person and scene: what happens in a step, and all that a checkpoint must hold."""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from torch import Tensor, nn

from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shadow import Stance
from stages.avatar.effects.speeds import FrameMotion
from stages.avatar.measures.lpips import Lpips
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import Resting, bone_transforms, pose
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.training import losses
from stages.training.clock import Clock
from stages.training.densify import Densifier
from stages.training.finishing.behind import inpaint_occluded
from stages.training.guard import Guard
from stages.training.layers import DrawnFrame, layers_of
from stages.training.optimizers import optimizers
from stages.training.patches import PatchLoss
from stages.training.person import PersonLearner
from stages.training.refine import FrameCorrections
from stages.training.schedule import Options, Progress, rate
from stages.training.settings import Params
from stages.training.transients import Transients
from stages.training.views import Person, Views, frame_speeds


class Fit:
    """State of one training run. `train` lists the frames that may be learned from; no other is looked at.

    Without a body and a model of the person, or without a scene, the other learns alone.
    """

    def __init__(
        self,
        views: Views,
        train: list[int],
        body: Person | None,
        human: HumanModel | None,
        scene: SceneModel | None,
        params: Params,
        options: Options,
        generator: torch.Generator,
        perceptual: Lpips | None = None,
        effects: FrameEffects | None = None,
        transients: Transients | None = None,
    ):
        self.full, self.small = views, views.half()
        self.train, self.scene, self.params, self.options = train, scene, params, options
        self.generator, self.patches, self.transients = generator, PatchLoss(perceptual, params, generator), transients
        self.half_until = params.half_until  # `rehearse` lowers it
        self.progress = Progress(params.steps, params.joint)
        self.guard, self.clock = Guard(), Clock()
        self.learner = None if body is None or human is None else PersonLearner(body, human, self.guard)
        self.frames = FrameCorrections(len(views.images), 0 if body is None else body.own_bones).to(views.viewmats)
        self.trained = torch.zeros(len(views.images), dtype=torch.bool)
        self.trained[train] = True
        self.effects = (effects or FrameEffects()).to(views.viewmats)
        self.speeds = frame_speeds(views, body) if self.effects.takes_time else None
        self.frame, self.undrawn = train[0], 0
        self.order = torch.empty(0, dtype=torch.long)
        self.before: dict[str, Any] | None = None
        self.adam = self._optimizers()
        self.densifier = Densifier(self.learner, scene, params, options, generator)

    @property
    def human(self) -> HumanModel | None:
        """The model of the person."""
        return None if self.learner is None else self.learner.human

    @property
    def person(self) -> PersonLearner:
        """The person who learns; ValueError where there is none."""
        if self.learner is None:
            raise ValueError("this training has no person")
        return self.learner

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return optimizers(self.frames, self.human, self.scene, self.options.extent, self.effects)

    def sizes(self) -> dict[str, int]:
        """How many Gaussians there are now, of each set."""
        return {"human": len(self.human) if self.human else 0, "scene": len(self.scene) if self.scene else 0}

    def modules(self) -> dict[str, nn.Module]:
        """All that has parameters or other tensors to keep, by name."""
        parts = {"human": self.human, "scene": self.scene, "frames": self.frames, "effects": self.effects}
        return {n: m for n, m in (parts | {"transients": self.transients}).items() if m is not None}

    # ---- one step ----

    def advance(self) -> dict[str, float]:
        """Learn from one training frame; returns the losses.

        FloatingPointError after too many bad steps in a row, ValueError when no Gaussian is left; `before` is then the
        state from which this step fails again.
        """
        self.clock.start()
        self.before = copy.deepcopy(self.state()) if self.guard.alarmed else None
        self.densifier.grow(self.progress, self.adam)
        if "scene" in self.adam:
            self.densifier.settle(self.progress, self.adam["scene"], self._inpaint)
        self.clock.lap("growth")
        self.frame = self._next_frame()
        self._set_rates()
        views = self.small if self.progress.done < self.half_until else self.full
        numbers = self._learn(self.frame, views)
        self.progress.step += 1
        step, group = self.progress.step, self.params.views_per_decode
        if self.learner is not None and (step % group == 0 or step == self.progress.total):
            self.learner.learn(self.adam["human"], step % group or group)
            self.clock.lap("person's networks")
        return numbers

    def _next_frame(self) -> int:
        if len(self.order) == 0:
            self.order = torch.randperm(len(self.train), generator=self.generator)
        frame, self.order = self.train[int(self.order[0])], self.order[1:]
        return frame

    def _set_rates(self) -> None:
        for optimizer in self.adam.values():
            for group in optimizer.param_groups:
                group["lr"] = group["base"] * rate(group["name"], self.progress.done)

    def _learn(self, frame: int, views: Views) -> dict[str, float]:
        shot = self._draw(frame, views)
        if shot is None:
            return {}
        loss, numbers = self._compare(shot)
        finite = math.isfinite(loss.item())
        self.guard.left_out += not finite
        self.guard.count("loss", not finite, f"{numbers}")
        if finite:
            loss.backward()
            self.clock.lap("backward")
            self._teach(shot)
            self.clock.lap("optimiser")
        return numbers

    def _drawn_person(self, frame: int, mask: Tensor) -> PersonLearner | None:
        """The person where they are drawn at a frame: mask[H,W] in 0..1 shows them, and their pose there is trusted."""
        learner = self.learner
        if learner is None or not self.progress.phase.human or not learner.body.confidence[frame] > 0:
            return None
        return learner if (mask > 0.5).any() else None

    def _draw(self, frame: int, views: Views) -> DrawnFrame | None:
        """Draw the layers that the losses of a frame need; None where it has nothing to teach."""
        image, mask = views.images[frame].float() / 255, views.masks[frame].float() / 255
        viewmat, K = self._camera(frame), views.Ks[frame]
        height, width = mask.shape
        gains = self.frames.gains(frame) if self.options.exposure else None
        person, stance, resting, scene = None, None, None, None
        if learner := self._drawn_person(frame, mask):
            self.clock.start()
            resting = learner.resting()
            self.clock.lap("person's networks")
            body = self.body(frame)
            person, stance = self.posed(resting, *body, frame=frame), self.stance(*body)
        if self.scene is not None and (self.progress.phase.scene or person is not None):
            scene = self.scene.splats()
            if not self.progress.phase.scene:
                scene = scene.detach()
        layers = layers_of(person, scene, mask, viewmat, K, self.params, self.generator)
        if not layers:
            return None
        motion, lit = self.motion(frame, resting), self.effects.shade(scene, stance)
        pictures = self.effects.draw(person, lit, motion, Camera(viewmat, K, width, height), list(layers.values()))
        self.clock.lap("drawing")
        self.undrawn += pictures[0].dropped
        return DrawnFrame(frame, image, mask, gains, person, scene, layers, dict(zip(layers, pictures)))

    def _compare(self, shot: DrawnFrame) -> tuple[Tensor, dict[str, float]]:
        """The loss of a frame, and its parts that are worth seeing."""
        image, mask, gains, drawn = shot.image, shot.mask, shot.gains, shot.drawn
        terms: list[Tensor | float] = []
        numbers: dict[str, float] = {}
        if shot.scene is not None:
            rendered = drawn["all"].image if gains is None else drawn["all"].image * gains
            if self.params.human_loss or shot.person is None:
                rendered = losses.outside_person(rendered, image, mask)
            if self.transients is not None:
                rendered = self.transients.replace(rendered, drawn["all"], image, shot.frame, self.progress.done)
            if self.params.perceptual_whole:
                terms.append(self.patches(self.progress.step, rendered, image))
            whole = losses.photometric(rendered, image)
            terms.append(whole)
            numbers["image"] = whole.item()
        if "person" in drawn:
            trust = self.person.body.confidence[shot.frame]  # a doubtful pose teaches little
            only, target = drawn["person"], shot.person_target()
            bare = (1 - only.alpha)[..., None] * target[2]
            rendered = only.image if gains is None else bare + gains * (only.image - bare)
            if self.effects.blurs:
                rendered = losses.unmixed(rendered, *target)
            apart = losses.person_only(rendered, only.alpha, *target)
            terms.append(trust * apart)
            terms.append(trust * self.patches(self.progress.step, rendered, *target))
            numbers["person"] = apart.item()
        if "occluders" in drawn:
            there = mask[shot.window("occluders")]
            terms.append(losses.OCCLUDERS * (drawn["occluders"].alpha * there).mean())
        self.clock.lap("losses")
        terms += [self.effects.prior(), self.frames.swing_prior(shot.frame, self.train)]
        return torch.as_tensor(sum(terms)), numbers

    def _teach(self, shot: DrawnFrame) -> None:
        """Take a step with the gradients of a frame; the person's wait for those of other frames."""
        statistics, rows = self.densifier.statistics, 0 if shot.person is None else len(shot.person.means)
        height, width = shot.mask.shape
        if self.scene is not None and shot.scene is not None and self.progress.phase.scene:
            whole = shot.drawn["all"]
            statistics["scene"].add(whole.screen_grad_abs[rows:], whole.radii[rows:], width, height)
            self.densifier.keep_settled()
            self.scene.add_sparsity_gradient(losses.FRUGAL)
            self._apply("scene")
            self.scene.clamp_opacities()
        if shot.person is not None:
            layer = "person" if "person" in shot.drawn else "all"
            drawn, (height, width) = shot.drawn[layer], shot.mask[shot.window(layer)].shape
            statistics["human"].add(drawn.screen_grad_abs[:rows], drawn.radii[:rows], width, height)
        self._apply("frames")
        self._learn_effects()

    def _apply(self, name: str) -> None:
        """One step of an optimiser whose parameters have one row a Gaussian, or sparse ones of one row a frame."""
        optimizer = self.adam[name]
        grads = {g["name"]: g["params"][0].grad for g in optimizer.param_groups}
        rows = {n: g._values() if g.is_sparse else g for n, g in grads.items() if g is not None}
        if rows:
            self.guard.contain(name, rows)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def _learn_effects(self) -> None:
        if "effects" in self.adam:
            grads = [p.grad for p in self.effects.parameters() if p.grad is not None]
            if grads and self.guard.clip("effects", grads):
                self.adam["effects"].step()
                self.effects.clamp_times()
            self.adam["effects"].zero_grad(set_to_none=True)

    def _inpaint(self, scene: SceneModel) -> Tensor:
        """Inpaint what the person hides or shades of the scene; returns which Gaussians, bool[N]."""
        views, points = self.full._replace(viewmats=self.cameras()), scene.means.detach()
        return inpaint_occluded(scene, views, self.train, lambda frame: self._shadow_depth(frame, points))

    def _shadow_depth(self, frame: int, points: Tensor) -> Tensor:
        there = self._drawn_person(frame, self.full.masks[frame] / 255)
        return self.effects.shadow_depth(points, self.stance(*self.body(frame)) if there else None)

    # ---- what there is at a frame ----

    def posed(self, resting: Resting, *at: Tensor, frame: int | None = None) -> Splats:
        """The person in the world and its light `at` a pose as of `body`; clothes as they swing in a `frame`, or in that pose."""
        body, (orient, body_pose, transl) = self.person.body, at
        bones = bone_transforms(body.joints, body.parents, orient, body_pose)
        if body.clothing is not None:
            bones = body.clothing.hang(bones, self.frames.swing_of(frame, self.effects.swing(body_pose)))
        return self.effects.lit(pose(resting, bones, transl)._replace(antialias=self.options.antialias))

    def stance(self, global_orient: Tensor, body_pose: Tensor, transl: Tensor) -> Stance:
        """How the person's body stands, for the shadow."""
        return Stance(self.person.body.joints, self.person.body.parents, global_orient, body_pose, transl)

    def motion(self, frame: int, resting: Resting | None) -> FrameMotion | None:
        """How everything moves at a frame, where an effect needs to know it; None for `resting`: nobody is drawn."""
        if self.speeds is None:
            return None
        return self.speeds.at(frame, resting and (lambda i: self.posed(resting, *self.body(i)).means))

    def body(self, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """global_orient[3], body_pose[69] and transl[3] of a frame, corrected where poses are refined."""
        p = self.person.body
        body = (p.global_orient[frame], p.body_pose[frame], p.transl[frame])
        return self.frames.body(frame, *body) if self.options.refine_pose else body

    def _camera(self, frame: int) -> Tensor:
        viewmat = self.full.viewmats[frame]
        return self.frames.camera(frame, viewmat, self.trained) if self.options.refine_camera else viewmat

    # ---- of all frames ----

    def bodies(self) -> tuple[Tensor, Tensor, Tensor]:
        """Corrected global_orient[F,3], body_pose[F,69], transl[F,3]; untrained frames take their neighbours' correction."""
        body = self.person.body
        if not self.options.refine_pose:
            return body.global_orient, body.body_pose, body.transl
        return self.frames.bodies(body, self.trained, self.full.moments)

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

    # ---- checkpoints ----

    def state(self) -> dict[str, Any]:
        """Everything that the rest of the run depends on, in part by reference."""
        return {
            "models": {n: m.state_dict() for n, m in self.modules().items()},
            "adam": {n: a.state_dict() for n, a in self.adam.items()},
            "densifier": self.densifier.state(),
            "guard": self.guard.state(),
            "generator": self.generator.get_state(),
            "order": self.order.clone(),
            "progress": self.progress.state(),
            "undrawn": self.undrawn,
            "person": None if self.learner is None else self.learner.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Continue from a `state()`; raises RuntimeError, naming tensor and shapes, when it belongs to another model."""
        for name, module in self.modules().items():
            saved = state["models"][name]
            owned = [(module, row) for row in getattr(module, "ROWS", ())]
            if isinstance(module, HumanModel):
                owned += module.rows()
            for owner, row in owned:
                old, like = getattr(owner, row), torch.empty_like(saved[row if owner is module else f"residuals.{row}"])
                setattr(owner, row, nn.Parameter(like) if isinstance(old, nn.Parameter) else like)
            module.load_state_dict(saved)
        self.adam = self._optimizers()
        for name, optimizer in self.adam.items():
            optimizer.load_state_dict(state["adam"][name])
        self.densifier.load(state["densifier"])
        self.guard.load(state["guard"])
        self.generator.set_state(state["generator"].cpu())  # both live on the CPU, wherever the rest was loaded
        self.order = state["order"].cpu().clone()
        self.progress.load(state["progress"])
        self.undrawn = state["undrawn"]
        if self.learner is not None:
            self.learner.load(state["person"])

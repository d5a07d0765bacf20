"""One joint optimisation of people and scene: what happens in a step, and all that a checkpoint must hold."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from stages.avatar.drawing.cast import Cast
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.measures.lpips import Lpips
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import Resting
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera
from stages.training.settings import Params
from stages.training.step import losses
from stages.training.step.behind import inpaint_occluded
from stages.training.step.clock import Clock
from stages.training.step.densify import Densifier
from stages.training.step.guard import Guard
from stages.training.step.layers import DrawnFrame, DrawnPerson, alone, layers_of, occluders
from stages.training.step.optimizers import FRAMES, optimizers
from stages.training.step.patches import PatchLoss
from stages.training.step.person import Learning, PersonLearner, Starting
from stages.training.step.refine import FrameCorrections
from stages.training.step.schedule import Options, Progress, rate
from stages.training.step.transients import Transients
from stages.training.views import Poses, Views, frame_speeds


class Fit:
    """State of one training run. `train` lists the frames that may be learned from; no other is looked at.

    Without people, or without a scene, the other learns alone. The masks of `views` are of all `people`.
    """

    def __init__(
        self,
        views: Views,
        train: list[int],
        people: Sequence[Starting],
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
        self.people = [PersonLearner(one, self.guard, number) for number, one in enumerate(people, 1)]
        self.frames = FrameCorrections(len(views.images)).to(views.viewmats)
        self.trained = torch.zeros(len(views.images), dtype=torch.bool)
        self.trained[train] = True
        self.effects = (effects or FrameEffects()).to(views.viewmats)
        clothes = [p.body.clothing for p in self.people if p.body.clothing is not None]
        self.effects.clothes = nn.ModuleList(clothes).to(views.viewmats) if clothes else None
        self.speeds = frame_speeds(views) if self.effects.takes_time else None
        self.frame, self.undrawn = train[0], 0
        self.order = torch.empty(0, dtype=torch.long)
        self.before: dict[str, Any] | None = None
        self.adam = self._optimizers()
        self.densifier = Densifier(self.people, scene, params, options, generator)

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        people = {p.name: (p.human, p.corrections) for p in self.people}
        return optimizers(self.frames, people, self.scene, self.options.extent, self.effects)

    def sizes(self) -> dict[str, int]:
        """How many Gaussians there are now, of all people and of the scene."""
        return {"human": sum(len(p.human) for p in self.people), "scene": len(self.scene) if self.scene else 0}

    def modules(self) -> dict[str, nn.Module]:
        """All that has parameters or other tensors to keep, by name."""
        people = {p.name: p.human for p in self.people} | {f"frames of {p.name}": p.corrections for p in self.people}
        parts = {"scene": self.scene, "frames": self.frames, "effects": self.effects, "transients": self.transients}
        return {name: part for name, part in (people | parts).items() if part is not None}

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
        for optimizer in self.adam.values():
            for one in optimizer.param_groups:
                one["lr"] = one["base"] * rate(one["name"], self.progress.done)
        views = self.small if self.progress.done < self.half_until else self.full
        learn, numbers = self.networks_learn, self._learn(self.frame, views)
        self.progress.step += 1
        step, group = self.progress.step, self.params.views_per_decode
        last = step == self.progress.total or not self.networks_learn
        if self.people and learn and (last or step % group == 0):
            for learner in self.people:
                learner.learn(self.adam[learner.name], step % group or group)
            self.clock.lap("person's networks")
        return numbers

    @property
    def networks_learn(self) -> bool:
        """Whether the networks learn; what each Gaussian has in place of networks always does."""
        return not self.params.triplane or self.progress.done < self.params.networks_until

    def _next_frame(self) -> int:
        if len(self.order) == 0:
            self.order = torch.randperm(len(self.train), generator=self.generator)
        frame, self.order = self.train[int(self.order[0])], self.order[1:]
        return frame

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

    def _draw(self, frame: int, views: Views) -> DrawnFrame | None:
        """Draw the layers that the losses of a frame need; None where it has nothing to teach."""
        image, mask = views.images[frame].float() / 255, views.masks[frame].float() / 255
        height, width = mask.shape
        camera = Camera(self._camera(frame), views.Ks[frame], width, height)
        gains = self.frames.gains(frame) if self.options.exposure else None
        there, scene, phase = self.drawn_people(frame, views), None, self.progress.phase
        resting = []
        for learner in there:
            self.clock.start()
            resting.append(learner.resting(self.networks_learn))
            self.clock.lap("person's networks")
        if self.scene is not None and (phase.scene or there):
            scene = self.scene.splats() if phase.scene else self.scene.splats().detach()
        people = [
            self.performer(who, still, partial(self.pose, who), swings=True)
            for who, still in zip(there, resting, strict=True)
        ]
        moment = Cast(people, scene, self.effects, self.speeds).at(frame, people)
        seen = [learner.seen(views, frame) for learner in there]
        figures = [DrawnPerson(splats, *mask) for splats, mask in zip(moment.people, seen, strict=True)]
        layers = layers_of(figures, scene, camera.viewmat, camera.K, self.params, self.generator)
        if not layers:
            return None
        pictures = moment.draw(camera, list(layers.values()))
        self.clock.lap("drawing")
        self.undrawn += pictures[0].dropped
        return DrawnFrame(frame, image, mask, gains, there, figures, scene, layers, dict(zip(layers, pictures)))

    def _compare(self, shot: DrawnFrame) -> tuple[Tensor, dict[str, float]]:
        """The loss of a frame, and its parts that are worth seeing."""
        image, mask, gains, drawn = shot.image, shot.mask, shot.gains, shot.drawn
        terms: list[Tensor | float] = []
        numbers: dict[str, float] = {}
        if shot.scene is not None:
            rendered = drawn["all"].image if gains is None else drawn["all"].image * gains
            if self.params.human_loss or not shot.figures:
                rendered = losses.outside_person(rendered, image, mask)
            if self.transients is not None:
                rendered = self.transients.replace(rendered, drawn["all"], image, shot.frame, self.progress.done)
            whole = losses.photometric(rendered, image)
            terms.append(whole)
            numbers["image"] = whole.item()
        for k, figure in enumerate(shot.figures):
            if (name := alone(k)) in drawn:
                trust = shot.people[k].body.confidence[shot.frame]  # a doubtful pose teaches little
                only, target = drawn[name], shot.person_target(k)
                known = None if figure.known is None else figure.known[shot.window(name)]
                rendered, alpha = losses.compared(only.image, only.alpha, gains, known, self.effects.blurs, target)
                apart = losses.person_only(rendered, alpha, *target)
                terms.append(trust * apart)
                terms.append(trust * self.patches(self.progress.step, rendered, *target))
                numbers[name] = apart.item()
            if (name := occluders(k)) in drawn:
                there = figure.mask[shot.window(name)]
                terms.append(losses.OCCLUDERS * (drawn[name].alpha * there).mean())
        self.clock.lap("losses")
        priors = [p.corrections.prior(shot.frame, self.train) for p in self.people]
        terms += [self.effects.prior(), *priors, *(p.pull for p in shot.people)]
        return torch.as_tensor(sum(terms)), numbers

    def _teach(self, shot: DrawnFrame) -> None:
        """Take a step with the gradients of a frame; the person's wait for those of other frames."""
        statistics, rows = self.densifier.statistics, sum(len(figure.splats.means) for figure in shot.figures)
        height, width = shot.mask.shape
        if self.scene is not None and shot.scene is not None and self.progress.phase.scene:
            whole = shot.drawn["all"]
            statistics["scene"].add(whole.screen_grad_abs[rows:], whole.radii[rows:], width, height)
            self.densifier.keep_settled()
            self.scene.add_sparsity_gradient(losses.FRUGAL)
            self._apply("scene")
            self.scene.clamp_opacities()
        first = 0
        for k, (learner, figure) in enumerate(zip(shot.people, shot.figures, strict=True)):
            own = slice(first, first := first + len(figure.splats.means))
            layer = alone(k) if alone(k) in shot.drawn else "all"
            drawn, (height, width) = shot.drawn[layer], shot.mask[shot.window(layer)].shape
            statistics[learner.name].add(drawn.screen_grad_abs[own], drawn.radii[own], width, height)
            learner.learn_own(self.adam[learner.name])
        for name in self.adam:
            if name.startswith(FRAMES):
                self._apply(name)
        for learner in shot.people:
            learner.corrections.clamp_face()
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
        points = scene.means.detach()
        return inpaint_occluded(scene, self.seen(), self.train, lambda frame: self._shadow_depth(frame, points))

    def _shadow_depth(self, frame: int, points: Tensor) -> Tensor:
        there = self.drawn_people(frame, self.full)
        return self.effects.shadow_depth(points, [who.casters_in(*self.pose(who, frame)[:3]) for who in there])

    # ---- what there is at a frame, with the corrections learned so far ----

    def drawn_people(self, frame: int, views: Views) -> list[PersonLearner]:
        """Who is drawn at a frame: their mask shows them, and their pose there is trusted."""
        if not self.progress.phase.human:
            return []
        there = [p for p in self.people if p.body.confidence[frame] > 0]
        return [p for p in there if (p.mask(views, frame) > 127).any()]

    def performer(
        self, who: PersonLearner, resting: Resting, pose: Callable[[int], Poses], swings: bool = False
    ) -> Learning:
        """Somebody at rest, as a `Cast` draws them in the poses of frames; see `Learning`."""
        mien = who.mien if swings else who.body.mien(resting)
        return Learning(who, resting, pose, self.options.antialias, self.effects.clothes is not None, swings, mien)

    def pose(self, who: PersonLearner, frame: int) -> Poses:
        """Those of a frame, corrected where poses are refined, with the face where that is learned."""
        return who.corrections.pose_in(frame, who.body, self.options)

    def poses(self, who: PersonLearner) -> Poses:
        """Those of all frames; untrained frames take their neighbours' correction and face."""
        return who.corrections.poses(who.body, self.options, self.trained, self.full.moments)

    def _camera(self, frame: int) -> Tensor:
        viewmat = self.full.viewmats[frame]
        return self.frames.camera(frame, viewmat, self.trained) if self.options.refine_camera else viewmat

    def cameras(self) -> Tensor:
        """Corrected viewmats [F,4,4], of mean correction 0 over the training frames."""
        if not self.options.refine_camera:
            return self.full.viewmats
        return self.frames.cameras(self.full.viewmats, self.trained, self.full.moments)

    def gains(self) -> Tensor:
        """Exposure factors [F,3], of geometric mean 1 over the training frames."""
        if not self.options.exposure:
            return torch.ones_like(self.frames.gain.weight)
        return self.frames.all_gains(self.trained, self.full.moments)

    @torch.no_grad()
    def baked(self, who: PersonLearner) -> Learning:
        """Somebody as they are baked now, in the corrected poses of all frames; no gradients."""
        return self.performer(who, who.body.gloved(who.baked()[1]), self.poses(who).at)

    def cast(self, people: Sequence[Learning] | None = None) -> Cast:
        """The `people`, None: all, `baked`, and the scene; no gradients."""
        scene = None if self.scene is None else self.scene.splats().detach()
        there = [self.baked(who) for who in self.people] if people is None else people
        return Cast(there, scene, self.effects, self.speeds)

    def seen(self) -> Views:
        """The frames with corrected cameras and their exposure."""
        return self.full._replace(viewmats=self.cameras().detach(), gains=self.gains().detach())

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
            "people": [learner.state() for learner in self.people],
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
        for learner, saved in zip(self.people, state["people"], strict=True):
            learner.load(saved)

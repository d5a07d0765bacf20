"""One joint optimisation of people and scene: what happens in a step, and all that a checkpoint must hold."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from stages.avatar.effects.frames import FrameEffects
from stages.avatar.measures.lpips import Lpips
from stages.avatar.model.human import HumanModel
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import together
from stages.training.settings import Params
from stages.training.step import losses
from stages.training.step.behind import inpaint_occluded
from stages.training.step.clock import Clock
from stages.training.step.company import Company
from stages.training.step.densify import Densifier
from stages.training.step.guard import Guard
from stages.training.step.layers import DrawnFrame, Figure, layers_of, numbered
from stages.training.step.optimizers import FRAMES, optimizers
from stages.training.step.outlines import Outline
from stages.training.step.patches import PatchLoss
from stages.training.step.person import Another, PersonLearner
from stages.training.step.refine import FrameCorrections
from stages.training.step.schedule import Options, Progress, rate
from stages.training.step.transients import Transients
from stages.training.views import Person, Views, frame_speeds


class Fit(Company):
    """State of one training run. `train` lists the frames that may be learned from; no other is looked at.

    Without a body and a model of the person, or without a scene, the other learns alone. Where `others` learn, too, the masks
    of `views` are of everybody, and `outline` tells of the first.
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
        outline: Outline | None = None,
        others: Sequence[Another] = (),
    ):
        self.full, self.small = views, views.half()
        self.train, self.scene, self.params, self.options = train, scene, params, options
        self.generator, self.patches, self.transients = generator, PatchLoss(perceptual, params, generator), transients
        self.half_until = params.half_until  # `rehearse` lowers it
        self.progress = Progress(params.steps, params.joint)
        self.guard, self.clock = Guard(), Clock()
        self.people: list[PersonLearner] = []
        if body is not None and human is not None:
            self.people.append(PersonLearner(body, human, self.guard, outline))
        for k, (theirs, model, seen) in enumerate(others, 1):
            self.people.append(PersonLearner(theirs, model, self.guard, seen, numbered("human", k)))
        self.frames = FrameCorrections(len(views.images)).to(views.viewmats)
        self.trained = torch.zeros(len(views.images), dtype=torch.bool)
        self.trained[train] = True
        self.effects = (effects or FrameEffects()).to(views.viewmats)
        clothes = [p.body.clothing for p in self.people if p.body.clothing is not None]
        self.effects.clothes = nn.ModuleList(clothes).to(views.viewmats) if clothes else None
        self.speeds = frame_speeds(views, body) if self.effects.takes_time else None
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
        self._set_rates()
        views = self.small if self.progress.done < self.half_until else self.full
        numbers = self._learn(self.frame, views)
        self.progress.step += 1
        step, group = self.progress.step, self.params.views_per_decode
        if self.people and (step % group == 0 or step == self.progress.total):
            for learner in self.people:
                learner.learn(self.adam[learner.name], step % group or group)
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

    def _draw(self, frame: int, views: Views) -> DrawnFrame | None:
        """Draw the layers that the losses of a frame need; None where it has nothing to teach."""
        image, mask = views.images[frame].float() / 255, views.masks[frame].float() / 255
        viewmat, K = self._camera(frame), views.Ks[frame]
        height, width = mask.shape
        gains = self.frames.gains(frame) if self.options.exposure else None
        there, scene = self.drawn_people(frame, views), None
        resting, figures, stances = [], [], []
        for learner in there:
            self.clock.start()
            resting.append(learner.resting())
            self.clock.lap("person's networks")
            body = self.body(frame, learner)
            person = self.posed(resting[-1], *body, frame=frame, of=learner)
            figures.append(Figure(person, *learner.seen(views, frame)))
            stances.append(self.stance(*body, of=learner))
        if self.scene is not None and (self.progress.phase.scene or figures):
            scene = self.scene.splats()
            if not self.progress.phase.scene:
                scene = scene.detach()
        layers = layers_of(figures, scene, viewmat, K, self.params, self.generator)
        if not layers:
            return None
        motion, lit = self.motion(frame, there, resting), self.effects.shade(scene, *stances)
        people, camera = together([figure.splats for figure in figures]), Camera(viewmat, K, width, height)
        pictures = self.effects.draw(people, lit, motion, camera, list(layers.values()))
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
            alone, occluders = numbered("person", k), numbered("occluders", k)
            if alone in drawn:
                trust = shot.people[k].body.confidence[shot.frame]  # a doubtful pose teaches little
                only, target = drawn[alone], shot.person_target(k)
                known = None if figure.known is None else figure.known[shot.window(alone)]
                rendered, alpha = losses.compared(only.image, only.alpha, gains, known, self.effects.blurs, target)
                apart = losses.person_only(rendered, alpha, *target)
                terms.append(trust * apart)
                terms.append(trust * self.patches(self.progress.step, rendered, *target))
                numbers[alone] = apart.item()
            if occluders in drawn:
                there = figure.mask[shot.window(occluders)]
                terms.append(losses.OCCLUDERS * (drawn[occluders].alpha * there).mean())
        self.clock.lap("losses")
        swings = [p.corrections.swing_prior(shot.frame, self.train) for p in self.people]
        terms += [self.effects.prior(), *swings, *(p.pull for p in shot.people)]
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
            layer = numbered("person", k) if numbered("person", k) in shot.drawn else "all"
            drawn, (height, width) = shot.drawn[layer], shot.mask[shot.window(layer)].shape
            statistics[learner.name].add(drawn.screen_grad_abs[own], drawn.radii[own], width, height)
            learner.learn_own(self.adam[learner.name])
        for name in self.adam:
            if name.startswith(FRAMES):
                self._apply(name)
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
        there = self.drawn_people(frame, self.full)
        return self.effects.shadow_depth(points, *(self.stance(*self.body(frame, p), of=p) for p in there))

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

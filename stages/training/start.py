"""Everything that is trained, at its initial value: from a clip, as `formats.clip.Clip` has it, and train's settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.smpl import DA_POSE, Body
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shadow import DARKNESS, casters
from stages.avatar.effects.sky import RADIUS, open_sky, shell
from stages.avatar.measures.lpips import Lpips
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import rest
from stages.avatar.model.scene import SceneModel, clear_of_cameras, fill_points, scene_extent
from stages.avatar.motion.formulas import upright
from stages.avatar.splats.neighbours import spread_evenly
from stages.avatar.splats.sh import sh_from_rgb
from stages.training.fit import Fit
from stages.training.init_colors import seen_colors
from stages.training.schedule import Options
from stages.training.transients import Transients
from stages.training.views import Person, Views

PAINTED = 24  # frames from which the person's first colours are read
LEAST_DARK = 0.05  # share of the light, at least, that a shadow begins with: at 0 it would learn nothing
FILLED = 16  # frames from which points of the scene are filled in


class Start:
    """Makes the parts of a training, in this order, from `train`, the frames of a clip that may be learned from.

    `params` has the settings of stages/train.py; `decisions`, and by effect where to begin, `starts`, are those of
    survey.json; `say` hears what is worth knowing.
    """

    def __init__(
        self,
        clip: Any,
        train: list[int],
        params: Any,
        decisions: dict[str, bool],
        starts: dict[str, list[float]],
        seed: int,
        device: str,
        say: Callable[[str], None],
    ):
        self.clip, self.train, self.params, self.decisions, self.starts = clip, train, params, decisions, starts
        self.seed, self.device, self.say = seed, device, say
        self.generator = torch.Generator().manual_seed(seed)

    def fit(self, perceptual: Lpips | None) -> Fit:
        """The training, before its first step."""
        clip, params, on = self.clip, self.params, self.decisions
        views, person = self._views(), self._person()
        human = self._human(person, views)
        extent = scene_extent(self._tensor(clip.viewmats).cpu(), self._tensor(clip.points).cpu())
        scene = self._scene(person, extent) if on.get("scene", True) and len(clip.points) else None
        options = Options(
            steps=params.steps,
            views_per_decode=params.views_per_decode,
            human_cap=self._cap("human", human),
            scene_cap=self._cap("scene", scene),
            extent=extent,
            refine_pose=on.get("pose_refinement", True),
            exposure=on.get("exposure", False),
            perceptual_every=params.perceptual_every,
            half_until=params.half_until,
            human_densify=params.human_densify,
            human_loss=params.human_loss,
            joint=params.joint,
            antialias=on.get("antialias", False),
            refine_camera=on.get("camera_refinement", False),
            early_stop=params.early_stop,
        )
        effects = self._effects(person, human)
        transients = Transients(views, self.train) if on.get("transients", False) and scene is not None else None
        return Fit(views, self.train, person, human, scene, options, self.generator, perceptual, effects, transients)

    def _cap(self, name: str, begun: HumanModel | SceneModel | None) -> int:
        """Most Gaussians of the person or the scene: what is set, or what it begins with."""
        cap, count = getattr(self.params, f"{name}_cap"), 0 if begun is None else len(begun)
        if count > cap:
            who = "person" if name == "human" else name
            self.say(f"the {who} begins with {count:,} Gaussians, more than {name}_cap ({cap:,}), and gets no more")
        return max(cap, count)

    def _tensor(self, array: Any) -> Tensor:
        return torch.as_tensor(np.asarray(array), dtype=torch.float32, device=self.device)

    def _views(self) -> Views:
        clip, frames = self.clip, range(len(self.clip.names))
        images, masks = (np.stack([read(i) for i in frames]) for read in (clip.images, clip.mask))
        pictures = (torch.as_tensor(pixels, device=self.device) for pixels in (images, masks))
        moments = torch.as_tensor(clip.split.moments, device=self.device)
        return Views(*pictures, self._tensor(clip.viewmats), self._tensor(clip.Ks), moments)

    def _person(self) -> Person:
        fitted, model = self.clip.body, self.clip.body_model
        body, betas = Body(model), torch.as_tensor(fitted.betas, dtype=torch.float32)
        vertices, _ = body(betas, torch.zeros(1, 3), DA_POSE[None], torch.zeros(1, 3))
        joints, at = self._tensor(body.rest(betas)[1]), self._tensor(vertices[0])
        faces = torch.as_tensor(np.asarray(model.faces).astype(np.int64), device=self.device)
        parts = (fitted.global_orient, fitted.body_pose, fitted.transl, fitted.confidence)
        weights, canonical = body.lbs_weights.to(self.device), DA_POSE.to(self.device)
        return Person(*map(self._tensor, parts), joints, body.parents, canonical, at, weights, faces)

    def _human(self, person: Person, views: Views) -> HumanModel:
        params = self.params
        human = HumanModel(
            person.vertices,
            person.faces,
            person.weights,
            rounds=params.rounds,
            channels=params.channels,
            resolution=params.resolution,
            sh_degree=params.human_sh,
            generator=self.generator,
            lbs_learning=params.lbs_learning,
            triplane=params.triplane,
        )
        seen = [i for i in self.train if person.confidence[i] > 0]
        colors, known = seen_colors(human, person, views, spread_evenly(seen, PAINTED))
        human.sh_starts.copy_(sh_from_rgb(colors))
        share = (known == 1).float().mean().item()
        self.say(f"{100 * share:.0f} % of the person's surface is seen by the training frames; the rest is a guess")
        return human

    def _scene(self, person: Person, extent: float) -> SceneModel | None:
        """None where all points lie on a camera."""
        clip, on, chosen = self.clip, self.decisions, spread_evenly(self.train, FILLED)
        images, masks = [clip.images(i) for i in chosen], [clip.mask(i) for i in chosen]
        cameras, skies = (clip.viewmats[chosen], clip.Ks[chosen]), None
        if on.get("sky", False):
            skies = [open_sky(clip.points, mask, *camera) for mask, *camera in zip(masks, *cameras, strict=True)]
        rng, places = np.random.default_rng(self.seed), clip.body.transl[chosen] + person.joints[0].cpu().numpy()
        xyz, rgb = fill_points(clip.points, images, masks, *cameras, places, self.params.scene_fill, rng, skies)
        points = self._tensor(np.concatenate([clip.points, xyz]))
        colors = self._tensor(np.concatenate([clip.colors, rgb])) / 255
        clear = clear_of_cameras(points, self._tensor(clip.viewmats), extent)
        if not clear.all():
            self.say(f"{int((~clear).sum())} points left out that lie on a camera")
        if not clear.any():
            return None
        degree = self.params.scene_sh if on.get("view_dependence", False) else 0
        scene = SceneModel(points[clear], colors[clear], degree, extent, on.get("antialias", False))
        if skies:
            far, tints, middle = shell(skies, images, *cameras, extent)
            self.say(f"{len(far):,} Gaussians of the sky, {RADIUS * extent:.0f} m away")
            if len(far):
                scene.add_sky(self._tensor(far), self._tensor(tints), self._tensor(middle), RADIUS * extent)
        return scene

    def _effects(self, person: Person, human: HumanModel) -> FrameEffects:
        on, orient = self.decisions, self.clip.body.global_orient
        *light, darkness = self.starts.get("shadow", [*upright(orient, orient[0])[:, 1], DARKNESS])
        light = torch.as_tensor(light).to(person.joints)
        takes = {name: on.get(name, False) for name in ("motion_blur", "rolling_shutter")}
        takes["shadow"] = min(max(darkness, LEAST_DARK), 1 - LEAST_DARK) if on.get("shadow", False) else None
        parts = casters(person.vertices, person.weights).posed(torch.linalg.inv(person.canonical_bones()))
        effects = FrameEffects.starting(light, parts, **takes)
        if on.get("clothing", False):
            bare = rest(human.initial(), person.canonical_bones()).means
            effects.clothing = Clothing.start(bare, person.body_pose[self.train])
        return effects

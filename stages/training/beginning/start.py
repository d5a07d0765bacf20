"""Everything that is trained, at its initial value."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.avatar.body.fingers import bent_skin, finger_joints
from stages.avatar.body.hull import CELL
from stages.avatar.body.smpl import DA_POSE, Body
from stages.avatar.drawing.attach import FaceSkin, HandSkin
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shading import Shading
from stages.avatar.effects.shadow import DARKNESS
from stages.avatar.effects.sky import RADIUS, open_sky, shell
from stages.avatar.measures.lpips import Lpips
from stages.avatar.model.human import HumanModel
from stages.avatar.model.scene import SceneModel, clear_of_cameras, fill_points, scene_extent
from stages.avatar.model.skin import even_skin
from stages.avatar.motion.placing import mean_up
from stages.avatar.splats.neighbours import spread_evenly
from stages.avatar.splats.sh import sh_from_rgb
from stages.contract import StageError
from stages.formats.clip import Clip
from stages.formats.hands_face import read_hands_face
from stages.training.beginning.cloth import clothed
from stages.training.beginning.init_colors import seen_colors
from stages.training.settings import Params
from stages.training.step.fit import Fit
from stages.training.step.outlines import Outline, outlines
from stages.training.step.person import Starting
from stages.training.step.schedule import Options
from stages.training.step.transients import Transients
from stages.training.views import FittedBody, FittedHands, Views

PAINTED = 24  # frames from which the person's first colours are read
SEEN = 0.6  # share of the person's surface below which the clip shows too few sides
LEAST_DARK = 0.05  # share of the light, at least, that a shadow begins with: at 0 it would learn nothing
COARSE = 7_000  # points of the skin beside which those of cloth are a CELL apart
FILLED = 16  # frames from which points of the scene are filled in


@dataclass(frozen=True)
class Task:
    """What a training is to learn, and how.

    `decisions` and first values (`starts`) are those of survey.json, by effect; `perceptual` is the network of the
    perceptual loss, where the settings ask for it. `clips` is the clip with the body and the masks of each of its people.
    """

    clips: Sequence[Clip]
    params: Params
    decisions: dict[str, bool] = field(default_factory=dict)
    starts: dict[str, list[float]] = field(default_factory=dict)
    seed: int = 0
    device: str = "cpu"
    perceptual: Lpips | None = None

    def chosen(self, settings: dict[str, int], left_out: Iterable[str]) -> Task:
        """The same with other settings, and without some effects."""
        decisions = self.decisions | dict.fromkeys(left_out, False)
        return replace(self, params=self.params.model_copy(update=settings), decisions=decisions)

    def frames(self) -> list[int]:
        """The frames to learn from; StageError where there is none, or none that shows a person with a body fit."""
        clip = self.clips[0]
        train = [i for i in range(len(clip.names)) if clip.training[i]]
        train = spread_evenly(train, self.params.frames_used or len(train))
        if not train:
            raise StageError(
                "no frame is left to train on",
                facts=[f"{len(clip.names)} frames registered, {int(clip.heldout.sum())} of them held out"],
                hint="give more frames to training in the data set's split",
            )
        shown = [i for i in train if clip.shows_person(i)]
        if not shown:
            raise StageError(
                "no training frame shows a person",
                facts=[f"the masks of all {len(train)} training frames are empty"],
                hint="give masks of your own: `hugs run VIDEO --masks DIR`",
            )
        if not any(clip.body.confidence[i] > 0 for i in shown):
            raise StageError(
                "no training frame has a body fit to learn from",
                facts=[f"{len(shown)} of {len(train)} training frames show the person, but none has a reliable pose"],
                hint="give a fit of your own: `hugs run VIDEO --smpl-fit FILE`",
            )
        return train


def build(task: Task, note: Callable[[str], None], warn: Callable[[str], None] | None = None) -> Fit:
    """The training of a task before its first step; `note` hears what is worth knowing, `warn` (None: `note`) what to do better."""
    fit = _Start(task, note, warn or note).fit()
    params = task.params
    if fit.scene is None and not (params.human_loss and params.joint):
        raise StageError(
            "there is no scene to train the person with",
            facts=[f"human_loss: {params.human_loss}, joint: {params.joint}; without a scene both are needed"],
            hint="leave out `--set train.human_loss` and `--set train.joint`",
        )
    return fit


class _Start:
    """Makes the parts of a training, in this order."""

    def __init__(self, task: Task, note: Callable[[str], None], warn: Callable[[str], None]):
        self.train, self.note, self.warn = task.frames(), note, warn
        self.clips, self.clip, self.params, self.decisions = task.clips, task.clips[0], task.params, task.decisions
        self.starts, self.seed, self.device, self.perceptual = task.starts, task.seed, task.device, task.perceptual
        self.generator = torch.Generator().manual_seed(task.seed)

    def fit(self) -> Fit:
        clip, on = self.clip, self.decisions
        views = self._views()
        bodies = [self._person(one) for one in self.clips]
        people = [self._starting(*one, views) for one in zip(bodies, self._outlines(views, bodies), strict=True)]
        extent = scene_extent(self._tensor(clip.viewmats).cpu(), self._tensor(clip.points).cpu())
        scene = self._scene(extent) if on.get("scene", True) and len(clip.points) else None
        most = max((one.human for one in people), key=len)
        caps = {"human_cap": self._cap("human", most), "scene_cap": self._cap("scene", scene)}
        options = Options(
            extent=extent,
            refine_pose=on.get("pose_refinement", True),
            learn_face=any(body.learns_face for body in bodies),
            refine_camera=on.get("camera_refinement", False),
            exposure=on.get("exposure", False),
            antialias=on.get("antialias", False),
        )
        effects = self._effects()
        transients = Transients(views, self.train) if on.get("transients", False) and scene is not None else None
        params = self.params.model_copy(update=caps)
        how = params, options, self.generator, self.perceptual, effects, transients
        return Fit(views, self.train, people, scene, *how)

    def _cap(self, name: str, begun: HumanModel | SceneModel | None) -> int:
        """Most Gaussians of the person or the scene: what is set, or what it begins with."""
        cap, count = getattr(self.params, f"{name}_cap"), 0 if begun is None else len(begun)
        if count > cap:
            who = "person" if name == "human" else name
            self.note(f"the {who} begins with {count:,} Gaussians, more than {name}_cap ({cap:,}), and gets no more")
        return max(cap, count)

    def _tensor(self, array: Any) -> Tensor:
        return torch.as_tensor(np.asarray(array), dtype=torch.float32, device=self.device)

    def _views(self) -> Views:
        clip, frames = self.clip, range(len(self.clip.names))
        images, masks = (np.stack([read(i) for i in frames]) for read in (clip.images, clip.mask))
        return Views(
            torch.as_tensor(images, device=self.device),
            torch.as_tensor(masks, device=self.device),
            self._tensor(clip.viewmats),
            self._tensor(clip.Ks),
            torch.as_tensor(clip.split.moments, device=self.device),
        )

    def _outlines(self, views: Views, people: list[FittedBody]) -> list[Outline | None]:
        """What the frames tell of each of several people; None for one who is alone."""
        if len(people) == 1:
            return [None]
        frames = range(len(self.clip.names))
        masks = [np.stack([one.own_mask(i) for i in frames]) for one in self.clips]
        return [*outlines(views, [torch.as_tensor(one, device=self.device) for one in masks], people)]

    def _starting(self, body: FittedBody, outline: Outline | None, views: Views) -> Starting:
        body = self._clothed(body, views, outline)
        return Starting(body, self._human(body, views, outline), outline)

    def _person(self, clip: Clip) -> FittedBody:
        model, fitted = clip.body_model, clip.body
        body, betas = Body(model), torch.as_tensor(fitted.betas, dtype=torch.float32)
        # clothes hang at rest: legs apart would pull a skirt apart
        pose = torch.zeros_like(DA_POSE) if self.decisions.get("clothing", False) else DA_POSE
        vertices, _ = body(betas, torch.zeros(1, 3), pose[None], torch.zeros(1, 3))
        rig = read_hands_face(model)
        hands = face = None
        moves = fitted.face is not None or self.decisions.get("face", False)
        if rig is not None and len(rig.face_points) and moves:
            face = FaceSkin(*map(self._tensor, FaceSkin.of(rig, body, betas)))
        if rig is not None and clip.hand_shape is not None:  # the canonical pose leaves arms as they are at rest
            rest, _ = body.rest(betas)
            shape = torch.as_tensor(clip.hand_shape).float()
            vertices = vertices + bent_skin(rig, rest, shape) - rest
            if fitted.hands is not None:
                joints, skin = finger_joints(rig, rest)[0], HandSkin.of(rig, rest, body.lbs_weights, shape)
                skin = HandSkin(self._tensor(skin.points), self._tensor(skin.weights))
                hands = FittedHands(self._tensor(joints), self._tensor(shape), self._tensor(fitted.hands), skin)
        return FittedBody(
            self._tensor(fitted.global_orient),
            self._tensor(fitted.body_pose),
            self._tensor(fitted.transl),
            self._tensor(fitted.confidence),
            joints=self._tensor(body.rest(betas)[1]),
            parents=body.parents,
            canonical_pose=pose.to(self.device),
            vertices=self._tensor(vertices[0]),
            weights=body.lbs_weights.to(self.device),
            faces=torch.as_tensor(np.asarray(model.faces).astype(np.int64), device=self.device),
            hands=hands,
            face=face,
            expressions=None if fitted.face is None else self._tensor(fitted.face),
        )

    def _clothed(self, person: FittedBody, views: Views, seen: Outline | None) -> FittedBody:
        """The person with what stands off their body, where the clip calls for it."""
        if not self.decisions.get("clothing", False):
            return person
        alone = views if seen is None else views._replace(masks=seen.masks)
        clear = self.train if seen is None else seen.clear(self.train)
        found = clothed(person, alone, clear, CELL * math.sqrt(COARSE / self.params.human_points))
        if found.cloth is None or found.clothing is None:
            self.note("no cloth or hair is seen off the body")
        else:
            count, bones = len(found.cloth.means), len(found.clothing)
            self.note(f"{count:,} Gaussians of cloth or hair begin off the body, with {bones} bones of their own")
        return found

    def _human(self, person: FittedBody, views: Views, outline: Outline | None) -> HumanModel:
        params = self.params
        skin = even_skin(person.vertices, person.faces, person.weights, params.human_points)
        human = HumanModel(
            skin,
            person.cloth,
            channels=params.channels,
            resolution=params.resolution,
            generator=self.generator,
            lbs_learning=params.lbs_learning,
            triplane=params.triplane,
        )
        seen = [i for i in self.train if person.confidence[i] > 0]
        alone = views if outline is None else views._replace(masks=outline.masks)
        colors, known = seen_colors(human, person, alone, spread_evenly(seen, PAINTED))
        human.sh_starts.copy_(sh_from_rgb(colors))
        share = (known == 1).float().mean().item()
        tell, better = (self.warn, ": walk around the person next time") if share < SEEN else (self.note, "")
        tell(f"{100 * share:.0f} % of the person's surface is seen by the training frames, the rest is a guess{better}")
        return human

    def _scene(self, extent: float) -> SceneModel | None:
        """None where all points lie on a camera."""
        clip, on, chosen = self.clip, self.decisions, spread_evenly(self.train, FILLED)
        images, masks = [clip.images(i) for i in chosen], [clip.mask(i) for i in chosen]
        cameras, skies = (clip.viewmats[chosen], clip.Ks[chosen]), None
        if on.get("sky", False):
            skies = [open_sky(clip.points, mask, *camera) for mask, *camera in zip(masks, *cameras, strict=True)]
        rng = np.random.default_rng(self.seed)
        xyz, rgb = fill_points(clip.points, images, masks, *cameras, self.params.scene_fill, rng, skies)
        points = self._tensor(np.concatenate([clip.points, xyz]))
        colors = self._tensor(np.concatenate([clip.colors, rgb])) / 255
        clear = clear_of_cameras(points, self._tensor(clip.viewmats), extent)
        if not clear.all():
            self.note(f"{int((~clear).sum())} points left out that lie on a camera")
        if not clear.any():
            return None
        degree = self.params.scene_sh if on.get("view_dependence", False) else 0
        scene = SceneModel(points[clear], colors[clear], degree, extent, on.get("antialias", False))
        if skies:
            far, tints, middle = shell(skies, images, *cameras, extent)
            self.note(f"{len(far):,} Gaussians of the sky, {RADIUS * extent:.0f} m away")
            if len(far):
                scene.add_sky(self._tensor(far), self._tensor(tints), self._tensor(middle), RADIUS * extent)
        return scene

    def _effects(self) -> FrameEffects:
        on, orient = self.decisions, np.concatenate([one.body.global_orient for one in self.clips])
        *lamp, darkness = self.starts.get("shadow", [*mean_up(orient), DARKNESS])
        light = self._tensor(lamp)
        shadow = min(max(darkness, LEAST_DARK), 1 - LEAST_DARK) if on.get("shadow", False) else None
        times = {name: on.get(name, False) for name in ("motion_blur", "rolling_shutter")}
        effects = FrameEffects.starting(light, shadow, **times)
        effects.shading = Shading().to(light) if on.get("shading", False) else None
        return effects

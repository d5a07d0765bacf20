"""Who is there in a training, and what there is at a frame: people as they stand, cameras and exposure, as far as corrected."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.shadow import Stance
from stages.avatar.effects.speeds import FrameMotion, Speeds
from stages.avatar.model.human import HumanModel
from stages.avatar.model.person import Resting, bone_transforms, pose
from stages.avatar.model.scene import SceneModel
from stages.avatar.splats.gaussians import Splats
from stages.training.settings import Params
from stages.training.step.person import PersonLearner
from stages.training.step.refine import FrameCorrections
from stages.training.step.schedule import Options, Progress
from stages.training.views import Views


class Company:
    """The `people` of a clip, none, one or several, and their `scene`, if any, in the frames of `full`; those that are
    `trained` [F] are corrected.
    """

    people: list[PersonLearner]
    scene: SceneModel | None
    frames: FrameCorrections
    effects: FrameEffects
    params: Params
    options: Options
    progress: Progress
    full: Views
    speeds: Speeds | None
    trained: Tensor

    @property
    def human(self) -> HumanModel | None:
        """The model of the first person."""
        return self.people[0].human if self.people else None

    @property
    def person(self) -> PersonLearner:
        """The first person who learns; ValueError where there is none."""
        if not self.people:
            raise ValueError("this training has no person")
        return self.people[0]

    def drawn_people(self, frame: int, views: Views) -> list[PersonLearner]:
        """Who is drawn at a frame: their mask shows them, and their pose there is trusted."""
        if not self.progress.phase.human:
            return []
        there = [p for p in self.people if p.body.confidence[frame] > 0]
        return [p for p in there if (p.mask(views, frame) > 127).any()]

    # ---- what there is at a frame; `of` whom: the first person where nobody is named ----

    def posed(self, resting: Resting, *at: Tensor, frame: int | None = None, of: PersonLearner | None = None) -> Splats:
        """A person in the world and its light `at` a pose as of `body`; clothes as they swing in a `frame`, or in that pose."""
        who, (orient, body_pose, transl) = of or self.person, at
        body, clothing = who.body, who.body.clothing
        bones = bone_transforms(body.joints, body.parents, orient, body_pose)
        if clothing is not None:
            told = self.effects.swing(clothing, body_pose)
            bones = clothing.hang(bones, who.corrections.swing_of(frame, told))
        return self.effects.lit(pose(resting, bones, transl)._replace(antialias=self.options.antialias))

    def stance(
        self, global_orient: Tensor, body_pose: Tensor, transl: Tensor, of: PersonLearner | None = None
    ) -> Stance:
        """How a person's body stands, for the shadow."""
        who = of or self.person
        parts = None if who is self.person else who.casters
        return Stance(who.body.joints, who.body.parents, global_orient, body_pose, transl, parts)

    def motion(self, frame: int, people: Sequence[PersonLearner], resting: Sequence[Resting]) -> FrameMotion | None:
        """How everything moves at a frame, where an effect needs to know it; `people` are drawn as they are `resting`."""
        if self.speeds is None:
            return None
        each = []
        for who, still in zip(people, resting, strict=True):

            def means(i: int, who: PersonLearner = who, still: Resting = still) -> Tensor:
                return self.posed(still, *self.body(i, who), of=who).means

            known = None if who is self.person else (who.body.confidence > 0).cpu().numpy()
            each.append(self.speeds.at(frame, means, known))
        if len(each) < 2:
            return each[0] if each else self.speeds.at(frame, None)
        own = [torch.zeros_like(r.means) if one.person is None else one.person for one, r in zip(each, resting)]
        return each[0]._replace(person=torch.cat(own))

    def body(self, frame: int, of: PersonLearner | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """global_orient[3], body_pose[69] and transl[3] of a frame, corrected where poses are refined."""
        who = of or self.person
        p = who.body
        body = (p.global_orient[frame], p.body_pose[frame], p.transl[frame])
        return who.corrections.body(frame, *body) if self.options.refine_pose else body

    def _camera(self, frame: int) -> Tensor:
        viewmat = self.full.viewmats[frame]
        return self.frames.camera(frame, viewmat, self.trained) if self.options.refine_camera else viewmat

    # ---- of all frames ----

    def bodies(self, of: PersonLearner | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Corrected global_orient[F,3], body_pose[F,69], transl[F,3]; untrained frames take their neighbours' correction."""
        who = of or self.person
        if not self.options.refine_pose:
            return who.body.global_orient, who.body.body_pose, who.body.transl
        return who.corrections.bodies(who.body, self.trained, self.full.moments)

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

"""The one place where a frame is drawn: people as they stand, lit, scene and people in shadow, and how all of it moves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from stages.avatar.effects.frames import FrameEffects
from stages.avatar.effects.motion_blur import BlurredRendering
from stages.avatar.effects.shadow import Casters
from stages.avatar.effects.speeds import FrameMotion, Speeds
from stages.avatar.rasterize import Camera, Kept, Layer, Rendering
from stages.avatar.splats.gaussians import Splats


class Performer(Protocol):
    """A person at the frames of a clip, or at the pictures of a film."""

    def shown(self, frame: int) -> bool:
        """Whether a frame shows the person."""

    def splats(self, frame: int) -> Splats:
        """The person's Gaussians in the world, in even light."""

    def casters(self, frame: int) -> Casters:
        """What casts the person's shadow, in the world."""

    def means(self, frame: int) -> Tensor | None:
        """Means [N,3] m of the Gaussians, to measure speed by; None where the pose is not known."""


class Moment(NamedTuple):
    """What a camera sees at one frame: `people` and `scene`, lit and shaded; each person's Gaussians move by `speeds` [N,3] m a
    moment, None: they stand. No `motion`: everything is drawn at one instant.
    """

    people: Sequence[Splats]
    scene: Splats | None = None
    effects: FrameEffects = FrameEffects()
    motion: FrameMotion | None = None
    speeds: Sequence[Tensor | None] | None = None

    @property
    def sets(self) -> list[Splats]:
        """The people in their order, then the scene."""
        return [*self.people, *([] if self.scene is None else [self.scene])]

    def draw(self, camera: Camera, layers: Sequence[Layer] = (Layer(),)) -> list[Rendering] | list[BlurredRendering]:
        """A picture for each layer, with rows in the order of `sets`; ValueError where nothing is there."""
        own = list(self.speeds or [None] * len(self.people)) + [None]
        return self.effects.draw(list(zip(self.sets, own)), self.motion, camera, layers)

    @torch.no_grad()
    def picture(
        self, camera: Camera, background: float = 0.0, kept: Kept | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours [H,W,3] over a grey `background` and coverage [H,W], float32; `kept` is that of a film whose camera may rest."""
        like = next((one.means for one in self.sets), torch.zeros(()))
        ground = torch.full((3,), background).to(like)
        (drawn,) = self.draw(camera.to(like), [Layer(background=ground, kept=kept)])
        return drawn.image.cpu().numpy(), drawn.alpha.cpu().numpy()


P = TypeVar("P", bound=Performer, covariant=True)


class Cast(NamedTuple, Generic[P]):
    """People and scene, with the effects under which they are drawn; `speeds` where an effect needs motion.

    People shade the scene; where shadows are `mutual`, each other, too. Nobody's shadow falls on themselves: the clip from
    which they were learned has it already.
    """

    people: Sequence[P]
    scene: Splats | None
    effects: FrameEffects
    speeds: Speeds | None = None
    mutual: bool = False

    def at(self, frame: int, people: Sequence[Performer] | None = None) -> Moment:
        """What there is at a frame; of `people`, or of those whom the frame shows."""
        there = [who for who in self.people if who.shown(frame)] if people is None else people
        effects, scene, bodies = self.effects, self.scene, []
        shown = [effects.lit(who.splats(frame)) for who in there]
        if effects.shadow is not None and (self.mutual or scene is not None):
            with torch.no_grad():
                bodies = [who.casters(frame) for who in there]
        if self.mutual:
            shown = [effects.shade(one, bodies[:k] + bodies[k + 1 :]) for k, one in enumerate(shown)]
        if scene is not None:
            scene = effects.shade(scene, bodies)
        if self.speeds is None:
            return Moment(shown, scene, effects)
        own = [self.speeds.own(frame, who.means) for who in there]
        return Moment(shown, scene, effects, self.speeds.at(frame), own)

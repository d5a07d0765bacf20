"""A film ready to be shot: its setting, cast and cameras, and what each picture is made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from stages.avatar.drawing.cast import Cast, Moment
from stages.avatar.drawing.pixels import cut_out, to_uint8
from stages.avatar.effects.frames import FrameEffects
from stages.avatar.rasterize import Camera, Kept
from stages.filming.cast import Actor
from stages.filming.parts import mark
from stages.filming.setting import Setting


@dataclass(frozen=True)
class Shoot:
    """`count` pictures, `fps` a second, one of `cameras` each."""

    setting: Setting
    cast: Sequence[Actor]
    cameras: Sequence[Camera]
    fps: float

    @property
    def count(self) -> int:
        return len(self.cameras)

    @property
    def names(self) -> list[str]:
        """What the people are called."""
        return [actor.name for actor in self.cast]

    def at(self, number: int) -> Moment:
        """What a picture shows, before it is drawn."""
        with torch.no_grad():
            return Cast(self.cast, self.setting.splats, self._light, mutual=True).at(number)

    def picture(self, number: int, kept: Kept | None = None) -> np.ndarray:
        """A picture, uint8 [H,W,3]: in the scene, or over white; `kept` from the one before."""
        white = 1.0 if self.setting.splats is None else 0.0
        return to_uint8(self.at(number).picture(self.cameras[number], white, kept)[0])

    def people(self, number: int, kept: Kept | None = None) -> np.ndarray:
        """The people of a picture alone, without shadows, uint8 [H,W,4], alpha not multiplied into colour."""
        with torch.no_grad():
            alone = Cast(self.cast, None, FrameEffects(shading=self.setting.shading)).at(number)
        return cut_out(*alone.picture(self.cameras[number], kept=kept))

    @cached_property
    def _light(self) -> FrameEffects:
        return FrameEffects(self.setting.shadow, shading=self.setting.shading)

    def pictures(self, numbers: range, alone: bool) -> Iterator[np.ndarray]:
        """Pictures in their order, of the people `alone` or of all."""
        shot, kept = self.people if alone else self.picture, Kept()
        return (shot(number, kept) for number in numbers)

    def where(self, seconds: float) -> int:
        """The picture that a second of the film falls on; the last one for all after it."""
        return round(min(self.count - 1, seconds * self.fps))

    def made_of(self, numbers: Sequence[int]) -> str:
        """A digest of all that these pictures are made of."""
        poses = [[(actor.pose(number), actor.cloth(number)) for actor in self.cast] for number in numbers]
        seen = [tuple(self.cameras[number]) for number in numbers]
        return mark(self.stuff, poses, seen)

    @cached_property
    def stuff(self) -> str:
        """A digest of what all pictures are made of: Gaussians, lamp, where people stand and how large they are."""
        scene, shadow, shading = self.setting.splats, self.setting.shadow, self.setting.shading
        lamp = None if shadow is None else [shadow.light(), *shadow.parameters()]
        light = None if shading is None else [*shading.parameters()]
        people = []
        for actor in self.cast:
            clothing = actor.baked.clothing
            cloth = None if clothing is None else [*clothing.buffers(), *clothing.parameters()]
            rest = list(actor.baked.resting), actor.baked.joints, actor.baked.parents, actor.baked.antialias
            moved = [list(part or ()) for part in (actor.baked.casters, actor.baked.gloves, actor.baked.face)]
            people.append([*rest, cloth, *moved, actor.place, actor.turn, actor.scale])
        return mark(None if scene is None else list(scene), lamp, light, people)

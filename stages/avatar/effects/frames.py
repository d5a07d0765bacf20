"""Draws a frame of the clip with the clip's effects: shadow, shading, motion blur, rolling shutter and clothes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from stages import records
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.motion_blur import START, BlurredRendering, expose
from stages.avatar.effects.rolling_shutter import roll_shutter
from stages.avatar.effects.shading import Shading
from stages.avatar.effects.shadow import Casters, Shadow
from stages.avatar.effects.speeds import FrameMotion, move, px_a_moment
from stages.avatar.rasterize import Camera, Layer, Rendering
from stages.avatar.splats.compose import draw_together
from stages.avatar.splats.gaussians import Splats


class FrameEffects(nn.Module):
    """The effects of one clip, each None where it is off; without any a frame is drawn by `compose` alone.

    `shutter` [1] is the share of a moment for which the shutter is open (motion blur), `readout` [1] the share in which
    the rows are read from top to bottom (rolling shutter). A moment is the time between two frames of the clip.
    `clothes` are the bones of clothes of those who wear such, `shading` is the light on people.
    """

    def __init__(
        self,
        shadow: Shadow | None = None,
        shutter: float | None = None,
        readout: float | None = None,
        shading: Shading | None = None,
    ):
        super().__init__()
        self.shadow = shadow
        self.shutter = None if shutter is None else nn.Parameter(torch.tensor([shutter]))
        self.readout = None if readout is None else nn.Parameter(torch.tensor([readout]))
        self.clothes: nn.ModuleList | None = None
        self.shading = shading

    @classmethod
    def starting(cls, light: Tensor, shadow: float | None, motion_blur: bool, rolling_shutter: bool) -> FrameEffects:
        """The effects that are on, with their first values.

        `light`[3] points towards the lamp as far as known, `shadow` is the share of light that a body takes.
        """
        times = START if motion_blur else None, 0.0 if rolling_shutter else None
        return cls(None if shadow is None else Shadow(light, shadow), *times).to(light)

    @property
    def takes_time(self) -> bool:
        """Whether drawing a frame needs its `FrameMotion`."""
        return self.blurs or self.readout is not None

    @property
    def blurs(self) -> bool:
        """Whether frames have motion blur."""
        return self.shutter is not None

    def prior(self) -> Tensor | float:
        """The regularizer of the effects, part of a step's loss."""
        parts = (*(self.clothes or ()), self.shading)
        return sum(part.prior() for part in parts if isinstance(part, Clothing | Shading))

    def lit(self, person: Splats) -> Splats:
        """A person in the clip's world, in its light."""
        return person if self.shading is None else self.shading(person)

    def shade(self, lit: Splats, bodies: Sequence[Casters]) -> Splats:
        """Gaussians of a scene with the shadows of posed `bodies`."""
        return lit if self.shadow is None else self.shadow(lit, bodies)

    @torch.no_grad()
    def shadow_depth(self, points: Tensor, bodies: Sequence[Casters]) -> Tensor:
        """Depth [N] of points[N,3] in the shadows of posed `bodies`: 0 in full light, 1 in full shadow."""
        if self.shadow is None or not bodies:
            return torch.zeros_like(points[:, 0])
        return (1 - self.shadow.light_left(points, bodies)) / self.shadow.darkness.sigmoid()

    def draw(
        self,
        sets: Sequence[tuple[Splats, Tensor | None]],
        motion: FrameMotion | None,
        camera: Camera,
        layers: Sequence[Layer],
    ) -> list[Rendering] | list[BlurredRendering]:
        """As `draw_together`, with motion blur and rolling shutter; each set moves by so much [N,3] m a moment, None: it stands.

        Without a `motion` everything is drawn at one moment.
        """
        if motion is None or not self.takes_time:
            return draw_together([splats for splats, _ in sets], camera, layers)
        moving = [(splats, motion.past(splats.means, own)) for splats, own in sets]

        def at(time: Tensor) -> list[Rendering]:
            return draw_together([self._at(*one, motion, time, camera.viewmat) for one in moving], camera, layers)

        if self.shutter is None:
            return at(motion.field.new_zeros(1))
        means, speeds = (torch.cat(parts) for parts in zip(*((s.means, by) for s, by in moving)))
        return expose(at, self.shutter, px_a_moment(means, speeds, camera))

    def _at(self, splats: Splats, speeds: Tensor, motion: FrameMotion, time: Tensor, viewmat: Tensor) -> Splats:
        spin = motion.field[:, :3]
        if self.readout is None:
            return move(splats, speeds, spin, time)
        return roll_shutter(splats, speeds, spin, viewmat, motion.K, motion.height, self.readout, time)

    @torch.no_grad()
    def clamp_times(self) -> None:
        """Clamp shutter and readout, in place, to one moment."""
        for value, low in ((self.shutter, 0.0), (self.readout, -1.0)):
            if value is not None:
                value.clamp_(low, 1.0)

    def known(self) -> dict[str, Any]:
        """The fields of `records.Effects` that are on."""
        times = {"shutter": self.shutter, "readout": self.readout}
        found: dict[str, Any] = {name: value.item() for name, value in times.items() if value is not None}
        if self.shading is not None:
            found["shading"] = self.shading.bands.detach().cpu().numpy()
        return found | ({} if self.shadow is None else self.shadow.known())


def load_effects(effects: records.Effects) -> FrameEffects:
    """Trained effects, as constants."""
    shadow, known = None, effects.known()
    if "light" in known:  # and with it the rest of a shadow
        numbers = (float(known[name]) for name in ("darkness", "softness", "density", "size"))
        shadow = Shadow(torch.as_tensor(known["light"]).float(), *numbers)
    shading = None if effects.shading is None else Shading(torch.as_tensor(effects.shading).float())
    return FrameEffects(shadow, effects.shutter, effects.readout, shading).requires_grad_(False)

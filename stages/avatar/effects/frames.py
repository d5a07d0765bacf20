"""How a frame of the clip is drawn where it calls for more than a sharp picture of everything at one moment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from stages import records
from stages.avatar.effects.clothing import Clothing
from stages.avatar.effects.motion_blur import START, Exposed, exposed
from stages.avatar.effects.rolling_shutter import rolled
from stages.avatar.effects.shadow import Casters, Shadow, Stance
from stages.avatar.effects.speeds import Motion, moved
from stages.avatar.model.person import Resting
from stages.avatar.rasterize import Camera, Layer, Rendering
from stages.avatar.splats.compose import compose
from stages.avatar.splats.gaussians import Splats


class FrameEffects(nn.Module):
    """The effects of one clip, each None where it is off; with none of them a frame is drawn as without this class.

    `shadow`; `shutter` [1], the share of a moment for which the shutter is open (motion blur); `readout` [1], the share
    in which the picture is read from top to bottom (rolling shutter). Moments are those of the clip's frames. `clothing`
    moves the person before they are posed.
    """

    def __init__(self, shadow: Shadow | None = None, shutter: float | None = None, readout: float | None = None):
        super().__init__()
        self.shadow = shadow
        self.shutter = None if shutter is None else nn.Parameter(torch.tensor([shutter]))
        self.readout = None if readout is None else nn.Parameter(torch.tensor([readout]))
        self.clothing: Clothing | None = None

    @classmethod
    def starting(
        cls, light: Tensor, body: Casters, shadow: float | None, motion_blur: bool, rolling_shutter: bool
    ) -> FrameEffects:
        """Those that are on, before any is learned; `light`[3] points to where the lamp may be, `body` is at rest.

        `shadow` is the share of light that the body takes.
        """
        times = START if motion_blur else None, 0.0 if rolling_shutter else None
        return cls(None if shadow is None else Shadow(light, body, shadow), *times).to(light)

    @property
    def takes_time(self) -> bool:
        """Whether a frame takes time, so that its `Motion` must be known."""
        return self.blurs or self.readout is not None

    @property
    def blurs(self) -> bool:
        """Whether frames are the mean of what moves."""
        return self.shutter is not None

    def dressed(self, person: Resting, body_pose: Tensor) -> Resting:
        """The person at rest, with what their clothes do in the pose [69]."""
        return person if self.clothing is None else self.clothing(person, body_pose)

    def prior(self) -> Tensor | float:
        """What speaks against effects that no picture calls for, to be added to a step's loss."""
        return 0.0 if self.clothing is None else self.clothing.prior()

    def lit(self, scene: Splats | None, stance: Stance | None) -> Splats | None:
        """The scene as a person who stands so leaves it light; None for nobody."""
        if self.shadow is None or scene is None or stance is None:
            return scene
        return self.shadow(scene, stance)

    @torch.no_grad()
    def dark(self, points: Tensor, stance: Stance | None) -> Tensor:
        """How deep each of points[N,3] is in the shadow of a person who stands so: 0 in the light, 1 where none deeper is."""
        if self.shadow is None or stance is None:
            return torch.zeros_like(points[:, 0])
        return (1 - self.shadow.left(points, stance)) / self.shadow.darkness.sigmoid()

    def draw(
        self,
        human: Splats | None,
        scene: Splats | None,
        motion: Motion | None,
        camera: Camera,
        layers: Sequence[Layer],
    ) -> list[Rendering] | list[Exposed]:
        """As `compose`, over the time that the shutter takes; without a `motion` at one moment."""
        if motion is None or not self.takes_time:
            return compose(human, scene, camera, layers)
        both = ((human, motion.person), (scene, None))

        def at(time: Tensor) -> list[Rendering]:
            person, rest = (None if s is None else self._at(s, own, motion, time, camera.viewmat) for s, own in both)
            return compose(person, rest, camera, layers)

        return at(motion.field.new_zeros(1)) if self.shutter is None else exposed(at, self.shutter)

    def _at(self, splats: Splats, own: Tensor | None, motion: Motion, time: Tensor, viewmat: Tensor) -> Splats:
        speeds, spin = motion.of(splats, own), motion.field[:, :3]
        if self.readout is None:
            return moved(splats, speeds, spin, time)
        return rolled(splats, speeds, spin, viewmat, motion.K, motion.height, self.readout, time)

    @torch.no_grad()
    def keep_possible(self) -> None:
        """Hold times, in place, within one moment."""
        for value, low in ((self.shutter, 0.0), (self.readout, -1.0)):
            if value is not None:
                value.clamp_(low, 1.0)

    def known(self) -> dict[str, Any]:
        """What `formats.effects.Effects` says of those that are on."""
        times = {"shutter": self.shutter, "readout": self.readout}
        found = {name: value.item() for name, value in times.items() if value is not None}
        return found | ({} if self.shadow is None else self.shadow.known())


def load_effects(effects: records.Effects) -> FrameEffects:
    """The effects that training found; nothing more to learn."""
    shadow, known = None, effects.known()
    if "light" in known:  # and with it the rest of a shadow
        numbers = (float(known[name]) for name in ("darkness", "softness", "density", "size"))
        body = Casters(torch.as_tensor(known["middles"]), torch.as_tensor(known["covariances"]))
        shadow = Shadow(torch.as_tensor(known["light"]).float(), body, *numbers)
    return FrameEffects(shadow, effects.shutter, effects.readout).requires_grad_(False)

"""A damped spring on each bone of clothes: how far it is behind where the skeleton carries it, and that it comes to rest."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from stages.avatar.effects.clothing import Clothing


class Springs:
    """The sway of the bones of `clothing` while the skeleton moves; at rest at first.

    u'' = -w^2 u - 2 z w u' - g'' for the sway u of a bone that is carried along g: between two poses g is straight, so a
    change of its speed is a push, and the swing between is exact at any frame rate (underdamped, z < 1).
    """

    def __init__(self, clothing: Clothing):
        self.clothing = clothing
        none = torch.zeros_like(clothing.centres)
        self.place: Tensor | None = None
        self.speed: Tensor | None = None
        self.sway, self.rate, self.time = none, none, 0.0

    def at(self, bones: Tensor, transl: Tensor, time: float) -> Tensor:
        """The sway [K,3] m in each carrier's axes at a `time` in s, later than the last, when the skeleton has bones[24,4,4].

        transl[3] m moves it in the world.
        """
        carried = self.clothing.carried(bones)
        place = (carried[:, :3, :3] @ self.clothing.centres[..., None])[..., 0] + carried[:, :3, 3] + transl
        seconds = time - self.time
        if self.place is not None and seconds > 0:
            speed = (place - self.place) / seconds
            if self.speed is not None:
                self.rate = self.rate - (speed - self.speed)
            self.speed = speed
            self._swing(seconds)
        self.place, self.time = place, time
        return (carried[:, :3, :3].mT @ self.sway[..., None])[..., 0]

    def _swing(self, seconds: float) -> None:
        free, damping = self.clothing.spring.double().tolist()
        fade, turn = free * damping, free * (1 - damping**2) ** 0.5
        t = torch.tensor(seconds, dtype=torch.float64)
        decay, cos, sin = (-fade * t).exp().item(), (turn * t).cos().item(), (turn * t).sin().item()
        u, v = self.sway, self.rate
        self.sway = decay * (u * (cos + fade / turn * sin) + v * (sin / turn))
        self.rate = decay * (v * (cos - fade / turn * sin) - u * (free**2 / turn * sin))


def sways(clothing: Clothing, bones: Tensor, transl: Tensor, times: Tensor) -> Iterator[Tensor]:
    """The sway [K,3] m at each of F poses: bones[F,24,4,4] and transl[F,3] m at times[F] s, rising."""
    springs = Springs(clothing)
    for one, place, time in zip(bones, transl, times.tolist(), strict=True):
        yield springs.at(one, place, time)

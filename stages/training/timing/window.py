"""What can be seen of a training while it runs: now and then a held-out frame beside the clip's, and the curve."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from stages.avatar.drawing.pixels import to_uint8
from stages.training.step.fit import Fit

EVERY = 5.0  # s, at least, between pictures
SHARE = 0.01  # of the training's time, at most, that pictures take


class Window:
    """Gives `picture` a strip uint8 [H,3W,3] (the clip, the frame drawn now, the person alone), and `curve` its rows so far.

    Pictures take SHARE of the time; nothing is drawn at random, so a training is the same with and without.
    """

    def __init__(
        self, picture: Callable[[np.ndarray], None], curve: Callable[[Sequence[dict[str, Any]]], None]
    ) -> None:
        self.picture, self.curve = picture, curve
        self.due, self.shown = 0.0, 0

    @torch.no_grad()
    def look(self, fit: Fit, frames: Sequence[int]) -> None:
        """Draw the next of `frames`, one after another, if it is time."""
        began = time.perf_counter()
        if not frames or began < self.due:
            return
        i, views, cast = frames[self.shown % len(frames)], fit.seen(), fit.cast()
        self.shown += 1
        image, moment, camera = views.images[i], cast.at(i), views.camera(i)
        alone = moment._replace(scene=None)
        gain = 1.0 if views.gains is None else views.gains[i].cpu().numpy()
        drawn = [to_uint8((moment.picture(camera)[0] * gain).clip(0, 1))] if moment.sets else []
        drawn += [to_uint8(alone.picture(camera, 1.0)[0].clip(0, 1))] if alone.sets else []
        self.picture(np.concatenate([image.cpu().numpy(), *drawn], 1))
        now = time.perf_counter()
        self.due = now + max(EVERY, (now - began) / SHARE)

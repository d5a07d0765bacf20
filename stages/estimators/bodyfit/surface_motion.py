"""Poses that move the person's surface as the pictures do: to the next frame, and to frames far away that show the same cloth."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from stages.estimators.bodyfit.flow import SurfaceFlow, flow_cost, surface_flow
from stages.estimators.bodyfit.posed import seen_vertices
from stages.estimators.bodyfit.ties import Ties

NEXT_SHARE, TIE_SHARE = 120.0, 100.0  # of flow to the next frame, and of ties to frames far away; all points share it
LOOK_EVERY = 1 / 6  # of the steps, after which it is seen anew which points are hidden
TIED_AT = (0.4, 0.7)  # share of the steps after which frames far apart are laid over each other


class SurfaceMotion:
    """What a clip's pictures say of how the person's surface moves."""

    def __init__(
        self,
        images: Sequence[np.ndarray],
        masks: Sequence[np.ndarray],
        times: np.ndarray,
        Ks: np.ndarray,
        faces: np.ndarray,
    ):
        """`images` uint8 [H,W,3] and `masks` uint8 [H,W] (255 = person) of F frames at `times` [F] s, `Ks` [F,3,3] px, `faces`
        [T,3] of the body."""
        self.Ks, self.faces = Ks, np.asarray(faces, np.int64)
        self.flow, self.ties = surface_flow(images, masks, times), Ties(images, masks, Ks, faces)
        self.tied: SurfaceFlow | None = None
        self.cloth_off: list[float] = []
        """How far cloth was off that frames far apart show, each time they were laid over each other: `Ties.find`."""
        self.next_look = 0.0
        self.shown = torch.zeros(len(images), 0)

    def cost(
        self, pixels: Tensor, height: Tensor, chosen: np.ndarray, bodies: Callable[[], np.ndarray], share: float
    ) -> Tensor:
        """Cost of vertices `chosen` [M], now at `pixels` [F,M,2], that move otherwise than the pictures do.

        `height` [F] px of the person; `bodies` gives all vertices [F,V,3] m in camera axes, when they are needed; `share` of
        the steps is over.
        """
        if share >= self.next_look:
            self.next_look += LOOK_EVERY
            self.shown = torch.tensor(seen_vertices(bodies(), self.faces, self.Ks, chosen), dtype=torch.float32)
        if len(self.cloth_off) < len(TIED_AT) and share >= TIED_AT[len(self.cloth_off)]:
            self.tied, off = self.ties.find(bodies())
            self.cloth_off.append(off)
        cost = NEXT_SHARE * flow_cost(self.flow, pixels, self.shown, height)
        if self.tied is not None:
            cost = cost + TIE_SHARE * flow_cost(self.tied, pixels, self.shown, height)
        return cost / len(chosen)

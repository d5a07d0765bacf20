"""The evidence of all detectors: the clip, points followed through it, residuals of the cameras, and exposure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stages.avatar.kernels.mesh import covered
from stages.estimators.bodyfit.posed import posed_bodies
from stages.estimators.detectors.bundle import BundleResiduals, adjust_bundle
from stages.estimators.detectors.light import frame_gains
from stages.estimators.detectors.tracks import Tracks, follow
from stages.formats.clip import Clip
from stages.formats.facts import Sfm
from stages.formats.images import evenly

FRAMES = 30  # enough for a median or a share; detectors that look at pictures take this many


@dataclass(frozen=True)
class ClipEvidence:
    """A clip before training, with the facts of sfm.json; what several detectors need is computed once."""

    clip: Clip
    facts: Sfm

    @property
    def moving(self) -> bool:
        """Whether the cameras stand apart, so that points can be placed."""
        return self.facts.verdict == "moving"

    @cached_property
    def tracks(self) -> Tracks:
        """The background's points."""
        return follow(self.clip)

    @cached_property
    def residuals(self) -> BundleResiduals | None:
        """How far the tracks contradict the cameras; None if too few points can be placed."""
        return adjust_bundle(self.tracks, self.clip.viewmats, self.clip.Ks, self.clip.height) if self.moving else None

    @cached_property
    def light(self) -> np.ndarray:
        """Log gains [F,3] of each frame: brightness, red/green, blue/green; NaN where too few points are seen."""
        return frame_gains(self.clip)

    @property
    def gains(self) -> np.ndarray:
        """Log gain [F] of each frame's brightness."""
        return self.light[:, 0]

    @cached_property
    def sampled(self) -> list[int]:
        """At most FRAMES frames, evenly spread."""
        return evenly(len(self.clip.names), FRAMES)

    @cached_property
    def bodies(self) -> np.ndarray:
        """Vertices of the body [len(sampled),V,3] m in the world."""
        return posed_bodies(self.clip.body_model, self.clip.body, self.sampled)

    @cached_property
    def outlines(self) -> list[np.ndarray]:
        """The body's silhouettes, bool [H,W] for each of `sampled`."""
        clip = self.clip
        return [
            covered(vertices, clip.body_model.faces, clip.viewmats[i], clip.Ks[i], clip.width, clip.height)
            for i, vertices in zip(self.sampled, self.bodies)
        ]

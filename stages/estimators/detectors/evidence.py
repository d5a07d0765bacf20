"""What the detectors look at: the clip, points followed through it, and what is already known of cameras and exposure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.kernels.mesh import NEAR, fill
from stages.estimators.detectors.bundle import Leftover, leftover
from stages.estimators.detectors.light import gains_of
from stages.estimators.detectors.tracks import Tracks, follow

if TYPE_CHECKING:
    from stages.formats.clip import Clip

FRAMES = 30  # enough for a median or a share; detectors that look at pictures take this many


@dataclass(frozen=True)
class Evidence:
    """A clip before training, and what `sfm.json` says of it; what several detectors need is worked out once."""

    clip: Clip
    facts: dict

    @property
    def moving(self) -> bool:
        """Whether the cameras stand apart, so that points can be placed."""
        return self.facts["verdict"] == "moving"

    @cached_property
    def tracks(self) -> Tracks:
        """The background's points."""
        return follow(self.clip)

    @cached_property
    def leftover(self) -> Leftover | None:
        """What the tracks say against the cameras; None where too few can be placed."""
        return leftover(self.tracks, self.clip.viewmats, self.clip.Ks, self.clip.height) if self.moving else None

    @cached_property
    def light(self) -> np.ndarray:
        """Log gains [F,3] of each frame, of all light and of red and blue beside green; NaN where too few points are seen."""
        return gains_of(self.clip)

    @property
    def gains(self) -> np.ndarray:
        """Log gain [F] of each frame, of all light."""
        return self.light[:, 0]

    @cached_property
    def some(self) -> list[int]:
        """At most FRAMES frames, evenly spread."""
        count = len(self.clip.names)
        return np.unique(np.linspace(0, count - 1, min(FRAMES, count)).round().astype(int)).tolist()

    @cached_property
    def posed(self) -> np.ndarray:
        """Vertices of the body [len(some),V,3] m in the world."""
        return posed(self.clip, self.some)

    @cached_property
    def outlines(self) -> list[np.ndarray]:
        """The body's silhouettes, bool [H,W] for each of `some`."""
        return [outline(self.clip, i, vertices) for i, vertices in zip(self.some, self.posed)]


def posed(clip: Clip, chosen: list[int]) -> np.ndarray:
    """Vertices [N,V,3] float64 m in the world of the bodies of the frames `chosen`."""
    body, poses = Body(clip.body_model), clip.body
    rows = [torch.as_tensor(part[chosen]).float() for part in (poses.global_orient, poses.body_pose, poses.transl)]
    with torch.no_grad():
        return body(torch.as_tensor(poses.betas).float(), *rows)[0].double().numpy()


def outline(clip: Clip, i: int, vertices: np.ndarray) -> np.ndarray:
    """The silhouette bool [H,W] of a body with `vertices` [V,3] in frame `i`; what is behind the camera is left out."""
    local = vertices @ clip.viewmats[i, :3, :3].T + clip.viewmats[i, :3, 3]
    faces = np.asarray(clip.body_model.faces, np.int64)
    faces = faces[(local[faces, 2] > NEAR).all(1)]
    local[:, 2] = np.maximum(local[:, 2], NEAR)
    return fill(local, faces, clip.Ks[i], clip.width, clip.height)[1] >= 0

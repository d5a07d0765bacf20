"""Drawing what training left, from arrays to arrays: no network, no gradient."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.compose import compose
from stages.avatar.gaussians import Splats
from stages.avatar.human import Baked, load_avatar, pose_avatar
from stages.avatar.scene import load_scene

Pose = tuple[np.ndarray, np.ndarray, np.ndarray]  # global_orient [3], body_pose [69] in rad, transl [3] in m


class Learned(NamedTuple):
    """A trained person and its scene, or None where only the person was trained."""

    avatar: Baked
    scene: Splats | None

    def person(self, pose: Pose) -> Splats:
        """The person's Gaussians in the world at one pose."""
        like = self.avatar.joints
        return pose_avatar(self.avatar, *(torch.as_tensor(part).to(like) for part in pose))


def load_learned(avatar, scene, device: str = "cpu") -> Learned:
    """Tensors on `device` from `formats.splats.Avatar` and `Scene` (or None)."""
    return Learned(load_avatar(avatar, device), None if scene is None else load_scene(scene, device))


def draw(
    human: Splats | None,
    scene: Splats | None,
    viewmat: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    background: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [H,W,3] over a grey `background` and coverage [H,W], float32.

    viewmat [4,4] camera_from_world in metres, K [3,3] px, size (width, height) px.
    """
    like = (human or scene).means
    view, intrinsics = (torch.as_tensor(m).to(like) for m in (viewmat, K))
    with torch.no_grad():
        drawn = compose(human, scene, view, intrinsics, *size, torch.full((3,), background).to(like))
    return drawn.image.cpu().numpy(), drawn.alpha.cpu().numpy()


def perform(
    learned: Learned,
    scene: Splats | None,
    moves: tuple[np.ndarray, np.ndarray, np.ndarray],
    stand: np.ndarray,
    transl: np.ndarray,
    views: Iterable[tuple[np.ndarray, np.ndarray]],
    size: tuple[int, int],
) -> Iterator[np.ndarray]:
    """Pictures of the person going through `moves`: global_orient, body_pose and steps, y up and z ahead.

    `stand` [3,3] takes their frame to the world, where steps [F,3] m are added to `transl` [3]; one view a move.
    """
    for turn, pose, step, view in zip(*moves, views, strict=True):
        turned = (Rotation.from_matrix(stand) * Rotation.from_rotvec(turn)).as_rotvec()
        human = learned.person((turned, pose, transl + stand @ step))
        yield to_uint8(draw(human, scene, *view, size, background=0.0 if scene else 1.0)[0])


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Values in 0..1 as bytes, clipped and rounded; raises ValueError when one is not finite."""
    if not np.isfinite(image).all():
        raise ValueError(f"{(~np.isfinite(image)).sum()} values of a picture are not finite")
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)

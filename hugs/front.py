"""Load an avatar, pose it, draw it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike

from stages import records
from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.drawing.avatar import Baked, pose_avatar
from stages.avatar.drawing.avatar import load_avatar as _load
from stages.avatar.drawing.cast import Moment
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.model.scene import load_scene as _load_scene
from stages.avatar.rasterize import Camera
from stages.avatar.splats.factor import factored
from stages.avatar.splats.gaussians import Splats
from stages.formats.exchange.read import read_any_avatar, read_any_scene
from stages.formats.images import write_image as _write
from stages.records import SH_C0


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in the world, metres: a posed person or a scene. Arrays are float32 and made when asked for."""

    splats: Splats
    """The same as tensors."""

    @cached_property
    def _arrays(self) -> records.Scene:
        return factored(self.splats)

    @property
    def means(self) -> np.ndarray:
        """Centres [N,3] m."""
        return self._arrays.means

    @property
    def quats(self) -> np.ndarray:
        """Rotations [N,4], w x y z, unit."""
        return self._arrays.quats

    @property
    def scales(self) -> np.ndarray:
        """Standard deviations [N,3] m along the axes of the rotation."""
        return self._arrays.scales

    @property
    def opacities(self) -> np.ndarray:
        """Opacities [N], 0 to 1."""
        return self._arrays.opacities

    @property
    def sh(self) -> np.ndarray:
        """Spherical harmonics [N,K,3] of the colours, in the order and signs of 3DGS files."""
        return np.concatenate([self._arrays.sh0[:, None], self._arrays.shN], 1)

    @property
    def colors(self) -> np.ndarray:
        """Colours [N,3], 0 to 1, of degree 0: the mean over all directions."""
        return np.clip(0.5 + SH_C0 * self._arrays.sh0, 0, 1)


@dataclass(frozen=True)
class Avatar:
    """A trained person."""

    baked: Baked
    """Gaussians at rest, skeleton and clothes, as tensors."""

    @property
    def joints(self) -> np.ndarray:
        """Joints [24,3] m at rest, named by JOINT_NAMES."""
        return self.baked.joints.cpu().numpy()

    def pose(
        self,
        body_pose: ArrayLike | None = None,
        global_orient: ArrayLike | None = None,
        transl: ArrayLike | None = None,
    ) -> Gaussians:
        """The person at one SMPL pose; what is left out is zero, and all zero is the T-pose, y up, facing z.

        `body_pose` [69] and `global_orient` [3] are rotation vectors in radians, `transl` [3] m. ValueError for others.
        """
        sizes = {"global_orient": (global_orient, 3), "body_pose": (body_pose, 69), "transl": (transl, 3)}
        parts = []
        for name, (value, size) in sizes.items():
            array = np.zeros(size) if value is None else np.asarray(value, np.float64)
            if array.shape != (size,) or not np.isfinite(array).all():
                raise ValueError(f"{name} has the shape {array.shape}, wanted are {size} finite numbers")
            parts.append(torch.as_tensor(array).to(self.baked.joints))
        return Gaussians(pose_avatar(self.baked, *parts))


def load_avatar(path: str | PathLike[str], device: str = "cpu") -> Avatar:
    """The avatar in avatar.npz or avatar_splats.glb; StageError, with facts and a hint, for any other file."""
    return Avatar(_load(read_any_avatar(Path(path)), device))


def load_scene(path: str | PathLike[str], device: str = "cpu") -> Gaussians:
    """The scene in a .ply, .spz or .npz of 3D Gaussians; StageError, with facts and a hint, for any other file.

    What of it is left out is a UserWarning.
    """
    scene = read_any_scene(Path(path))
    for fact in scene.said:
        warnings.warn(fact, stacklevel=2)
    return Gaussians(_load_scene(scene, device))


def camera(
    eye: ArrayLike,
    target: ArrayLike = (0.0, 0.0, 0.0),
    up: ArrayLike = (0.0, 1.0, 0.0),
    focal: float = 600.0,
    width: int = 512,
    height: int = 512,
) -> Camera:
    """A camera at `eye` that looks at `target` [3] m; `focal` in pixels. `up` is (0, -1, 0) in the world of a clip."""
    view = look_at(*(np.asarray(part, np.float64) for part in (eye, target, up)))
    return Camera.of(view, pinhole(focal, width, height), width, height)


def draw(
    person: Gaussians | None, camera: Camera, scene: Gaussians | None = None, background: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The picture [H,W,3] over a grey `background` and the coverage [H,W], float32, 0 to 1.

    Effects of a clip, such as the person's shadow, are not drawn; `hugs render` draws them.
    """
    behind = None if scene is None else scene.splats
    return Moment([] if person is None else [person.splats], behind).picture(camera, background)


def write_image(path: str | PathLike[str], image: np.ndarray) -> None:
    """Write a picture of `draw` as .png."""
    _write(Path(path), to_uint8(image))

"""Gaussians in the world: a scene, or people in poses."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any, Generic, TypeVar, cast, overload

import numpy as np
import torch
from torch import Tensor

from stages import records
from stages.avatar.body.smpl import Body
from stages.avatar.drawing.avatar import PosedAvatar
from stages.avatar.model.scene import load_scene as _load_scene
from stages.avatar.rasterize import gaussian_axes
from stages.avatar.splats.factor import factored
from stages.avatar.splats.gaussians import Splats
from stages.contract import StageError
from stages.formats.exchange.read import read_any_scene
from stages.records import SH_C0

Array = TypeVar("Array", np.ndarray, Tensor)


class Gaussians(Generic[Array]):
    """N Gaussians in the world, in metres: a scene, or a person in one pose or in P poses.

    With P poses each shape has a first axis [P,...]. Attributes are float32 arrays if the Gaussians were made from arrays, else
    tensors.

        scene = hugs.load_scene("scene.ply")
        image, alpha, depth = hugs.draw(None, camera, scene)
    """

    def __init__(self, sets: Sequence[Splats], batched: bool = False, arrays: bool = False):
        self._sets, self.batched, self.arrays = sets, batched, arrays

    @property
    def sets(self) -> Sequence[Splats]:
        """The Gaussians of each pose as tensors."""
        return self._sets

    @overload
    @staticmethod
    def of(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor) -> Gaussians[Tensor]: ...

    @overload
    @staticmethod
    def of(
        means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray, sh: np.ndarray
    ) -> Gaussians[np.ndarray]: ...

    @staticmethod
    def of(means: Any, quats: Any, scales: Any, opacities: Any, sh: Any) -> Gaussians[Any]:
        """Gaussians of your own: means [N,3] m, quats [N,4] (w x y z, any length), scales [N,3] m, opacities [N], 0 to 1, and
        sh [N,K,3], spherical harmonics of the colours as in 3DGS files; tensors keep their gradients.
        """
        given = (means, quats, scales, opacities, sh)
        arrays = not any(isinstance(part, Tensor) for part in given)
        means, quats, scales, opacities, sh = map(torch.as_tensor, given)
        return Gaussians([Splats(means, gaussian_axes(quats, scales), opacities, sh)], arrays=arrays)

    @property
    def count(self) -> int:
        """The number of Gaussians."""
        return len(self.sets[0].means)

    def __repr__(self) -> str:
        return f"<{self.count:,} Gaussians>"

    @property
    def means(self) -> Array:
        """Centres [N,3] m."""
        return self._given([one.means for one in self.sets])

    @property
    def axes(self) -> Array:
        """Scaled axes [N,3,3] m as columns: the covariance is axes @ axes.T."""
        return self._given([one.axes for one in self.sets])

    @property
    def opacities(self) -> Array:
        """Opacities [N], 0 to 1."""
        return self._given([one.opacities for one in self.sets])

    @property
    def quats(self) -> Array:
        """Rotations [N,4] as unit quaternions w x y z. They have no gradient; `axes` have."""
        return self._given([torch.from_numpy(one.quats) for one in self._factored])

    @property
    def scales(self) -> Array:
        """Standard deviations [N,3] m along the axes of the rotation. They have no gradient; `axes` have."""
        return self._given([torch.from_numpy(one.scales) for one in self._factored])

    @property
    def sh(self) -> Array:
        """Spherical harmonics [N,K,3] of the colours in the axes of the world, as in 3DGS files. They have no gradient."""
        parts = [np.concatenate([one.sh0[:, None], one.shN], 1) for one in self._factored]
        return self._given([torch.from_numpy(part) for part in parts])

    @property
    def colors(self) -> Array:
        """Colours [N,3], 0 to 1, of degree 0: the mean over all directions."""
        return self._given([(0.5 + SH_C0 * one.sh[:, 0]).clamp(0, 1) for one in self.sets])

    @cached_property
    def _factored(self) -> list[records.Scene]:
        return [factored(one) for one in self.sets]

    def _given(self, parts: Sequence[Tensor]) -> Array:
        """The tensors of all poses as one array, or one tensor if the person was posed by tensors."""
        whole = torch.stack(list(parts)) if self.batched else parts[0]
        return cast(Array, whole.detach().cpu().numpy() if self.arrays else whole)


class Person(Gaussians[Array]):
    """A person in one pose, or in P poses at once, from `Avatar.pose`: joints, body and Gaussians in the world, in metres.

    Skinning waits for the first use of the Gaussians, so joints alone are fast. `person[i]` is the person in pose i of P.

        wrist = avatar.pose(np.zeros(69)).joints[hugs.JOINT_NAMES.index("left_wrist")]
    """

    def __init__(self, posed: PosedAvatar, body: Body | None, betas: Tensor, batched: bool, arrays: bool):
        self.posed, self.body, self.betas, self.batched, self.arrays = posed, body, betas, batched, arrays
        self._made: dict[bool, list[Splats]] = {}
        posed.bones  # noqa: B018 - found now, with gradients if these are wanted here

    @property
    def sets(self) -> Sequence[Splats]:
        """The Gaussians in each pose as tensors."""
        wanted = torch.is_grad_enabled()  # those that were made without gradients have none later
        if wanted not in self._made:
            self._made[wanted] = self.posed.all_splats()
        return self._made[wanted]

    def __repr__(self) -> str:
        poses, hips = f" in {len(self)} poses" if self.batched else "", self.posed.joints[:, 0].detach().mean(0)
        place = ", ".join(f"{float(x):.2f}" for x in hips)
        return f"<a person of {self.count:,} Gaussians{poses}, hips at ({place}) m>"

    @property
    def count(self) -> int:
        """The number of Gaussians."""
        return len(self.posed.avatar.resting.means)

    def __len__(self) -> int:
        """The number of poses."""
        return len(self.posed.transl)

    def __getitem__(self, row: int) -> Person[Array]:
        """The person in one of the P poses; IndexError for a number out of range, TypeError if there is one pose only."""
        if not self.batched:
            raise TypeError("the person is in one pose, not in several")
        return Person(self.posed.row(range(len(self))[row]), self.body, self.betas, False, self.arrays)

    @property
    def joints(self) -> Array:
        """Joints [24,3] m, named by JOINT_NAMES; differentiable in the pose."""
        return self._given(list(self.posed.joints))

    @property
    def vertices(self) -> Array:
        """Vertices [V,3] m of the body without clothes, see `Avatar.faces`; differentiable in the pose.

        StageError if the body is unknown: that of a run is always known, that of an exported file only if it is the free body.
        """
        if self.body is None:
            raise StageError(
                "the body of this avatar is unknown, so there are no vertices",
                "load the folder of its run, which holds the body",
                ["an exported avatar holds joints and Gaussians, but no template of the body"],
            )
        posed = self.posed
        return self._given(list(self.body(self.betas, posed.global_orient, posed.body_pose, posed.transl)[0]))


def load_scene(path: str | PathLike[str], device: str = "cpu") -> Gaussians[Tensor]:
    """Load, to `device`, the scene of 3D Gaussians in the .ply, .spz or .npz file at `path`.

    A UserWarning names what is left out. StageError, with facts and a hint, for any other file.

        scene = hugs.load_scene("scene.ply")
    """
    scene = read_any_scene(Path(path))
    for fact in scene.said:
        warnings.warn(fact, stacklevel=2)
    return Gaussians([_load_scene(scene, device)])

"""Draws people and a scene, in the same way as the commands."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Generic, NamedTuple, cast, overload

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from hugs.gaussians import Array, Gaussians, Person
from stages import records
from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.drawing.cast import Cast
from stages.avatar.drawing.pixels import to_uint8
from stages.avatar.effects.frames import FrameEffects, load_effects
from stages.avatar.effects.shadow import Casters
from stages.avatar.rasterize import Camera, Layer
from stages.avatar.splats.gaussians import Splats
from stages.formats.images import write_image as _write


class Picture(NamedTuple, Generic[Array]):
    """A picture, or P pictures with a first axis [P,...].

    `image` [H,W,3], 0 to 1, has the background; `alpha` [H,W] is the covered share of each pixel; `depth` [H,W] m is the sum of
    depths z, each weighted by the share that it covers: depth / alpha is the mean.

        image, alpha, depth = hugs.draw(person, camera)
    """

    image: Array
    alpha: Array
    depth: Array


def camera(
    eye: ArrayLike,
    target: ArrayLike = (0.0, 0.0, 0.0),
    up: ArrayLike = (0.0, 1.0, 0.0),
    focal: float = 600.0,
    width: int = 512,
    height: int = 512,
) -> Camera:
    """A camera at `eye` [3] m that looks at `target` [3] m; `focal` in pixels. ValueError if both are the same point.

    `up` is (0, -1, 0) in the world of a clip. A camera from tensors is `hugs.Camera(viewmat, K, width, height)`.

        path = [hugs.camera((3 * np.sin(t), 0, 3 * np.cos(t))) for t in np.linspace(0, 6.28, 48)]
    """
    view = look_at(*(np.asarray(part, np.float64) for part in (eye, target, up)))
    return Camera.of(view, pinhole(focal, width, height), width, height)


@overload
def draw(
    person: Person[Array] | Sequence[Person[Array]],
    camera: Camera | Sequence[Camera],
    scene: Gaussians[Any] | None = None,
    background: float | ArrayLike | Tensor = 0.0,
    light: records.Effects | None = None,
) -> Picture[Array]: ...


@overload
def draw(
    person: None,
    camera: Camera | Sequence[Camera],
    scene: Gaussians[Array],
    background: float | ArrayLike | Tensor = 0.0,
    light: records.Effects | None = None,
) -> Picture[Array]: ...


def draw(
    person: Person[Any] | Sequence[Person[Any]] | None,
    camera: Camera | Sequence[Camera],
    scene: Gaussians[Any] | None = None,
    background: float | ArrayLike | Tensor = 0.0,
    light: records.Effects | None = None,
) -> Picture[Any]:
    """Draw a person, several people, or nobody (None), in front of a `scene` and a `background`, grey or [3].

    With P cameras, or people in P poses, there are P pictures; picture i has camera i and pose i. With `light`, usually
    `Avatar.light`, people are lit as in the clip and cast shadows on the scene. If all people hold arrays (without people: if the
    scene does), the picture holds arrays. Else it holds tensors on the device of the avatar, differentiable in the Gaussians, the
    poses, the background and the camera's viewmat and K, but not through shadows. Gaussians that are not finite are left out with
    a UserWarning. ValueError if there is neither person nor scene, if counts differ, or if a camera is not finite.

        image, alpha, depth = hugs.draw([ann, ben], avatar.cameras[:8], avatar.scene, light=avatar.light)
    """
    people = [] if person is None else [person] if isinstance(person, Person) else list(person)
    views = [camera] if isinstance(camera, Camera) else list(camera)
    counts = {len(one) for one in people if one.batched} | (set() if isinstance(camera, Camera) else {len(views)})
    if len(counts) > 1 or 0 in counts:
        raise ValueError(f"the numbers of cameras and poses differ: {len(views)} and {[len(one) for one in people]}")
    if not people and scene is None:
        raise ValueError("there is neither a person nor a scene to draw")
    count, first = next(iter(counts), 1), people[0] if people else scene
    arrays = all(one.arrays for one in people) if people else cast(Gaussians[Any], scene).arrays
    like = cast(Gaussians[Any], first).sets[0].means
    effects = FrameEffects() if light is None else load_effects(light).to(like)
    behind = None if scene is None else scene.sets[0]
    ground = torch.as_tensor(background).to(like).expand(3)
    stage, drawn = Cast([_Role(one) for one in people], behind, effects), []
    with torch.set_grad_enabled(torch.is_grad_enabled() and not arrays):
        for number in range(count):
            view = views[number if len(views) > 1 else 0].to(like)
            (picture,) = stage.at(number).draw(view, [Layer(background=ground)])
            if picture.dropped:
                warnings.warn(f"{picture.dropped} Gaussians that are not finite are left out", stacklevel=2)
            drawn.append((picture.image, picture.alpha, picture.depth))
        parts = [torch.stack(part) if counts else part[0] for part in zip(*drawn, strict=True)]
    return Picture(*(part.cpu().numpy() if arrays else part for part in parts))


@dataclass(frozen=True)
class _Role:
    """A person as an actor of a cast: frame i has pose i, or the only pose."""

    person: Person[Any]

    def _row(self, frame: int) -> int:
        return frame if self.person.batched else 0

    def shown(self, frame: int) -> bool:
        return True

    def splats(self, frame: int) -> Splats:
        return self.person.sets[self._row(frame)]

    def casters(self, frame: int) -> Casters:
        return self.person.posed.casters(self._row(frame))

    def means(self, frame: int) -> None:
        return None


def write_image(path: str | PathLike[str], image: np.ndarray | Tensor) -> None:
    """Write an `image` [H,W,3] of `draw`, clipped to 0 to 1, to a `path` that ends in .png.

    ValueError if a value is not finite, StageError if the file cannot be written.

        hugs.write_image("pose.png", hugs.draw(person, camera).image)
    """
    _write(Path(path), to_uint8(image.detach().cpu().numpy() if isinstance(image, Tensor) else image))

"""Puts a surface where the person hides the scene in every frame. What it shows is invented."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from stages.avatar.cameras.pinhole import project, unproject
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera, Rendering
from stages.avatar.splats.compose import compose, painted_pixels
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import spread_evenly
from stages.training.finishing.behind import HIDDEN, beside_and_behind
from stages.training.finishing.completion import complete, membrane
from stages.training.losses import dilated
from stages.training.views import LOOKS, Views

PLACES = 3  # that are filled, at most: somebody may stand here, then there
SMALL = 2e-3  # of a picture: places of fewer pixels stay as they are
OTHER = 0.5  # of the first place's pixels: a further one has as many at least
BESIDE = 0.003  # of the longer side: what is so near a person's outline shows little of the scene. 0: a trace of the ghost stays
INSIDE = 0.8  # of the pixels that a Gaussian paints: with more in a hole it goes. 0.5: the phone clip loses 0.06 dB
ROUND = 0.5  # px in the frame that shows most of it: sigma of the Gaussians that fill a hole, one for each pixel
FARTHEST = 1e3  # m: what fills a hole is no farther


def fill_hidden(scene: SceneModel, views: Views, frames: list[int], people: Callable[[int], Splats | None]) -> int:
    """Fill what the `people` of a frame hide of the scene in all `frames` of `views`; returns with how many Gaussians.

    The picture of the frame in which most is hidden is completed from what is around, and so is inverse depth, which is
    linear on a plane; nothing is nearer than the people. Gaussians that paint there until then go: no frame has taught them.
    """
    looks, filled = spread_evenly([i for i in frames if views.masks[i].max() > 127], LOOKS), 0
    if not looks:
        return 0
    painted = torch.stack([torch.stack(beside_and_behind(scene.splats().detach(), views, i)) for i in looks])
    least = SMALL * views.masks[0].numel()
    for _ in range(PLACES):
        splats, (beside, behind) = scene.splats().detach(), painted.unbind(1)
        hidden = behind.sum(0) > HIDDEN * beside.sum(0)
        most, which = behind[:, hidden].sum(1).max(0)
        key = looks[int(which)]
        person = people(key)
        hole = never_seen(splats, views, key, frames, person)
        if min(most, hole.sum()) < least:
            break
        kinds = torch.stack([hole, ~hole, torch.zeros_like(hole)], -1).to(splats.means)
        inside, outside, _ = painted_pixels(splats, views.viewmats[key], views.Ks[key], kinds).unbind(1)
        lost = inside > INSIDE * (inside + outside)
        surface = None if lost.all() else _surface(splats.rows(~lost), views, key, hole, person)
        if surface is None:
            break
        scene.exchange(lost, *surface)
        filled, least = filled + len(surface[0]), max(least, OTHER * float(most))
        painted = (painted * (inside == 0))[..., ~lost]  # what this place has is done
        painted = torch.cat([painted, painted.new_zeros(*painted.shape[:2], len(surface[0]))], -1)
    return filled


def never_seen(splats: Splats, views: Views, key: int, frames: list[int], person: Splats | None) -> Tensor:
    """Where [H,W] in frame `key` the `person` hides what none of the `frames` shows, if it is as deep as what is around them."""
    height, width = views.masks.shape[1:]
    masks = {i: (dilated(views.masks[i].float() / 255, BESIDE) > 0.5).cpu().numpy() for i in {key, *frames}}
    never = masks[key].copy()
    inverse = _inverse_depth(splats, views, key, never, person)[never]
    points = unproject(np.argwhere(never)[:, ::-1] + 0.5, inverse, *_camera(views, key))
    seen = np.zeros(len(points), bool)
    for i, mask in masks.items():
        pixels, z = project(points, *_camera(views, i))
        column, row = np.floor(pixels).clip(-1, max(height, width)).astype(int).T
        inside = (z > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        seen[inside] |= ~mask[row[inside], column[inside]]
    never[never] = ~seen
    return torch.as_tensor(never)


def _surface(splats: Splats, views: Views, key: int, hole: Tensor, person: Splats | None) -> list[Tensor] | None:
    """Points [P,3] m, colours [P,3] and sigmas [P] m that fill the hole [H,W] of frame `key`; None where nothing tells them."""
    unknown, (viewmat, K) = hole.numpy(), _camera(views, key)
    picture = complete(_drawn(splats, views, key).image.clamp(0, 1).cpu().numpy(), unknown)
    if picture is None:
        return None
    inverse = _inverse_depth(splats, views, key, unknown, person)[unknown]
    points = unproject(np.argwhere(unknown)[:, ::-1] + 0.5, inverse, viewmat, K)
    return [torch.as_tensor(part).to(splats.means) for part in (points, picture[unknown], ROUND / inverse / K[0, 0])]


def _drawn(splats: Splats, views: Views, frame: int) -> Rendering:
    height, width = views.masks.shape[1:]
    return compose(None, splats, Camera(views.viewmats[frame], views.Ks[frame], width, height))[0]


def _inverse_depth(splats: Splats, views: Views, frame: int, hole: np.ndarray, person: Splats | None) -> np.ndarray:
    """1 / z [H,W] of what is drawn, in a hole [H,W] as what is around it tells, but behind the person."""
    inverse = membrane(_over_depth(_drawn(splats, views, frame)), hole).clip(1 / FARTHEST)
    if person is None:
        return inverse
    drawn = _drawn(person, views, frame)
    there = (drawn.alpha > 0.5).cpu().numpy()
    return np.where(there, np.minimum(inverse, _over_depth(drawn)), inverse)


def _over_depth(drawn: Rendering) -> np.ndarray:
    return (drawn.alpha / drawn.depth.clamp_min(1e-6)).cpu().numpy()


def _camera(views: Views, frame: int) -> tuple[np.ndarray, np.ndarray]:
    return views.viewmats[frame].double().cpu().numpy(), views.Ks[frame].double().cpu().numpy()

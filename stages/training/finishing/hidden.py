"""Puts a surface where the person hides the scene in every frame. What it shows is invented."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from stages.avatar.cameras.pinhole import project, unproject
from stages.avatar.drawing.cast import Cast, Moment
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Camera, Rendering
from stages.avatar.rasterize.rendering import BLUR, PIXEL
from stages.avatar.splats.compose import painted_pixels
from stages.avatar.splats.gaussians import Splats
from stages.avatar.splats.neighbours import spread_evenly
from stages.training.finishing.completion import complete, membrane
from stages.training.step.behind import HIDDEN, beside_and_behind
from stages.training.step.losses import dilated
from stages.training.views import LOOKS, Views

PLACES = 3  # that are filled, at most: somebody may stand here, then there
SMALL = 2e-3  # of a picture: places of fewer pixels stay as they are
OTHER = 0.5  # of the first place's pixels: a further one has as many at least
BESIDE = 0.003  # of the longer side: what is so near a person's outline shows little of the scene. 0: a trace of the ghost stays
INSIDE = 0.8  # of the pixels that a Gaussian paints: with more in a hole it goes. 0.5: the phone clip loses 0.06 dB
THICK = 0.3  # m: what is hidden is so far behind what is seen of a person
ROUND = 0.5  # px in the frame that shows most of it: sigma of the Gaussians that fill a hole, one for each pixel
MOST = 30_000  # of them for a place: a larger hole has fewer and larger ones
FARTHEST = 1e4  # m: what fills a hole is no farther


def fill_hidden(scene: SceneModel, views: Views, frames: list[int], cast: Cast) -> int:
    """Fill what the people of `cast` hide of the scene in all `frames` of `views`; returns with how many Gaussians.

    The picture of the frame in which most is hidden is completed from what is around, and so is inverse depth, which is
    linear on a plane; nothing comes before the people there. Gaussians go that paint there and that frames hardly show.
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
        hole, inverse = never_seen(splats, views, key, frames, cast)
        if min(float(most), hole.sum()) < least:
            break
        kinds = torch.as_tensor(np.stack([hole, ~hole, np.zeros_like(hole)], -1)).to(splats.means)
        inside, outside, _ = painted_pixels(splats, views.viewmats[key], views.Ks[key], kinds).unbind(1)
        lost = (inside > INSIDE * (inside + outside)) & (behind.sum(0) > beside.sum(0))
        surface = None if lost.all() else _surface(splats.rows(~lost), views, key, hole, inverse)
        if surface is None:
            break
        scene.exchange(lost, *surface)
        filled, least = filled + len(surface[0]), max(least, OTHER * float(most))
        painted = (painted * (inside == 0))[..., ~lost]  # what this place has is done
        painted = torch.cat([painted, painted.new_zeros(*painted.shape[:2], len(surface[0]))], -1)
    return filled


@torch.no_grad()
def never_seen(splats: Splats, views: Views, key: int, frames: list[int], cast: Cast) -> tuple[np.ndarray, np.ndarray]:
    """Where [H,W] in frame `key` the people of `cast`, and a rim about them, hide what none of the `frames` shows; and 1 / z [H,W].

    Its depth is interpolated from around the person and kept behind them. A point outside a picture counts as not shown by it.
    """
    height, width = views.masks.shape[1:]
    never = _person(views, key)
    inverse = _inverse_depth(splats, views, key, never, cast)
    points = unproject(np.argwhere(never)[:, ::-1] + 0.5, inverse[never], *_camera(views, key))
    left = np.arange(len(points))
    for i in frames:
        pixels, z = project(points[left], *_camera(views, i))
        column, row = np.floor(pixels).clip(-1, max(height, width)).astype(int).T
        shown = (z > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        shown[shown] = ~_person(views, i)[row[shown], column[shown]]
        left = left[~shown]
        if not len(left):
            break
    never[never] = np.isin(np.arange(len(points)), left)
    return never, inverse


def _surface(splats: Splats, views: Views, key: int, hole: np.ndarray, inverse: np.ndarray) -> list[Tensor] | None:
    """Points [P,3] m, colours [P,3] and sigmas [P] m that fill the hole [H,W] of frame `key`; None where nothing tells them."""
    picture = complete(_drawn([splats], views, key).image.clamp(0, 1).cpu().numpy(), hole)
    if picture is None:
        return None
    step, at = math.ceil(math.sqrt(hole.sum() / MOST)), np.argwhere(hole)
    row, column = at[(at % step == 0).all(1)].T
    viewmat, K = _camera(views, key)
    points = unproject(np.stack([column, row], 1) + 0.5, inverse[row, column], viewmat, K)
    blur = BLUR - PIXEL if splats.antialias else 0  # so as to be as opaque with less blur on the screen
    sizes = step * math.sqrt(ROUND**2 + blur) / inverse[row, column] / K[0, 0]
    return [torch.as_tensor(part).to(splats.means) for part in (points, picture[row, column], sizes)]


def _person(views: Views, frame: int) -> np.ndarray:
    return (dilated(views.masks[frame].float() / 255, BESIDE) > 0.5).cpu().numpy()


def _drawn(sets: Sequence[Splats], views: Views, frame: int) -> Rendering:
    """Drawn at one instant."""
    height, width = views.masks.shape[1:]
    (drawn,) = Moment(sets).draw(Camera(views.viewmats[frame], views.Ks[frame], width, height))
    assert isinstance(drawn, Rendering), "nothing moves"
    return drawn


def _inverse_depth(splats: Splats, views: Views, frame: int, hole: np.ndarray, cast: Cast) -> np.ndarray:
    """1 / z [H,W] of what is drawn, in a hole [H,W] as what is around it tells, but THICK behind the person that is nearest."""
    inverse = membrane(_over_depth(_drawn([splats], views, frame)), hole).clip(1 / FARTHEST)
    people = cast.at(frame).people
    drawn = _drawn(people, views, frame) if people else None
    if drawn is None or not (there := (drawn.alpha > 0.5).cpu().numpy()).any():
        return inverse
    nearest = distance_transform_edt(~there, return_distances=False, return_indices=True)
    behind = 1 / (1 / _over_depth(drawn)[tuple(nearest)] + THICK)
    return np.where(hole, np.minimum(inverse, behind), inverse)


def _over_depth(drawn: Rendering) -> np.ndarray:
    return (drawn.alpha / drawn.depth.clamp_min(1e-6)).cpu().numpy()


def _camera(views: Views, frame: int) -> tuple[np.ndarray, np.ndarray]:
    return views.viewmats[frame].double().cpu().numpy(), views.Ks[frame].double().cpu().numpy()

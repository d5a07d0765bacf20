"""Puts a surface where the person hides the scene: of what frames show now and then, else, where none does, invented."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from stages.avatar.cameras.pinhole import project, unproject
from stages.avatar.drawing.cast import Cast, Moment
from stages.avatar.model.scene import SceneModel
from stages.avatar.rasterize import Rendering
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
HALO = 0.005  # of the longer side: what is known so near what is not has a little of the person's colours. 0: a grey figure
SELDOM = 0.1  # of the frames: what fewer show is taken from them
CLEAR = 8.0  # px from people's outlines, from where on a frame's colours count in full
INSIDE = 0.8  # of the pixels that a Gaussian paints: with more in a hole it goes. 0.5: the phone clip loses 0.06 dB
THICK = 0.3  # m: what is hidden is so far behind what is seen of a person
ROUND = 0.5  # px in the frame that shows most of it: sigma of the Gaussians that fill a hole, one for each pixel
MOST = 60_000  # of them for a place: a larger hole has fewer and larger ones
FARTHEST = 1e4  # m: what fills a hole is no farther


class Behind(NamedTuple):
    """A frame without its people: `colours` [H,W,3], where `never` [H,W] any frame shows them and where they `seldom` do, and
    `inverse` [H,W], 1 / z.
    """

    colours: np.ndarray
    never: np.ndarray
    seldom: np.ndarray
    inverse: np.ndarray


def fill_hidden(scene: SceneModel, views: Views, frames: list[int], cast: Cast) -> Tensor:
    """Fill what the people of `cast` hide of the scene in all `frames` of `views`; returns which Gaussians are invented, bool [N].

    It begins in the frame in which most is hidden. What a few frames show there has their colours; the picture is completed
    with what is around, and so is inverse depth, which is linear on a plane; nothing comes before the people there.
    Gaussians go that paint there and that frames hardly show.
    """
    looks = spread_evenly([i for i in frames if views.masks[i].max() > 127], LOOKS)
    invented = torch.zeros_like(scene.means[:, 0], dtype=torch.bool)
    if not looks:
        return invented
    painted = torch.stack([torch.stack(beside_and_behind(scene.splats().detach(), views, i)) for i in looks])
    least = SMALL * views.masks[0].numel()
    for _ in range(PLACES):
        splats, (beside, behind) = scene.splats().detach(), painted.unbind(1)
        hidden = behind.sum(0) > HIDDEN * beside.sum(0)
        most, which = behind[:, hidden].sum(1).max(0)
        key = looks[int(which)]
        found = seen_behind(splats, views, key, frames, cast)
        place = found.never | found.seldom
        if min(float(most), place.sum()) < least:
            break
        kinds = torch.as_tensor(np.stack([place, ~place, np.zeros_like(place)], -1)).to(splats.means)
        inside, outside, _ = painted_pixels(splats, views.viewmats[key], views.Ks[key], kinds).unbind(1)
        lost = (inside > INSIDE * (inside + outside)) & (behind.sum(0) > beside.sum(0))
        surface = _surface(splats, views, key, found)
        if surface is None:
            break
        scene.exchange(lost, *surface[1:])
        invented = torch.cat([invented[~lost], surface[0]])
        least = max(least, OTHER * float(most))
        painted = (painted * (inside == 0))[..., ~lost]  # what this place has is done
        painted = torch.cat([painted, painted.new_zeros(*painted.shape[:2], len(surface[0]))], -1)
    return invented


@torch.no_grad()
def seen_behind(splats: Splats, views: Views, key: int, frames: list[int], cast: Cast) -> Behind:
    """What the people of `cast`, and a rim about them, hide in frame `key`, by what the `frames` show of it.

    Its depth is interpolated from around the person and kept behind them. A point outside a picture counts as not shown by it.
    Colours are a mean over frames, without shadows; those count most in which it is lit and far from people's outlines.
    """
    height, width = views.masks.shape[1:]
    person = _clear(views, key) == 0
    inverse = _inverse_depth(splats, views, key, person, cast)
    everywhere = unproject(np.argwhere(np.ones_like(person))[:, ::-1] + 0.5, inverse.ravel(), *_camera(views, key))
    points = everywhere[person.ravel()]
    times, weights, sums = np.zeros(len(points)), np.full(len(points), 1e-6), np.zeros((len(points), 3))
    for i in frames:
        pixels, z = project(points, *_camera(views, i))
        column, row = np.floor(pixels).clip(-1, max(height, width)).astype(int).T
        shown = (z > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        clear = _clear(views, i)
        shown[shown] = clear[row[shown], column[shown]] > 0
        counts = clear[row[shown], column[shown]]
        times[shown] += 1
        weights[shown] += counts * _light(cast, i, points[shown])
        sums[shown] += counts[:, None] * _colours(views, i)[row[shown], column[shown]]
    often = np.full(person.shape, len(frames))
    often[person] = times
    colours = _colours(views, key) / _light(cast, key, everywhere).reshape(height, width, 1)
    colours[person] = sums / weights[:, None]
    never = often == 0
    return Behind(colours.clip(0, 1), never, ~never & (often < SELDOM * len(frames)), inverse)


def _clear(views: Views, frame: int) -> np.ndarray:
    """How far [H,W] pixels of a frame lie outside the rim about its people, CLEAR px at most."""
    beside = (views.masks[frame] < 128).byte().cpu().numpy()
    away = cv2.distanceTransform(beside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (away - BESIDE * max(away.shape)).clip(0, CLEAR)


def _colours(views: Views, frame: int) -> np.ndarray:
    """The colours [H,W,3] of a frame, as the scene has them."""
    gains = 1.0 if views.gains is None else views.gains[frame].cpu().numpy()
    return views.images[frame].cpu().numpy() / 255 / gains


def _light(cast: Cast, frame: int, points: np.ndarray) -> np.ndarray:
    """The share [N] of the light that the shadows of a frame's people leave to points [N,3] m."""
    shadow, bodies = cast.effects.shadow, [who for who in cast.people if who.shown(frame)]
    if shadow is None or not bodies:
        return np.ones(len(points))
    there = torch.as_tensor(points).to(shadow.darkness)
    return shadow.light_left(there, [who.casters(frame) for who in bodies]).cpu().numpy()


def _surface(splats: Splats, views: Views, key: int, found: Behind) -> list[Tensor] | None:
    """What fills the places `found` in frame `key`: which is invented bool [P], points [P,3] m, colours [P,3] and sigmas [P] m;
    None where nothing tells them.
    """
    unknown = (dilated(torch.as_tensor(found.never).float(), HALO) > 0.5).numpy()
    picture, place, inverse = complete(found.colours, unknown), found.never | found.seldom, found.inverse
    if picture is None:
        return None
    picture = np.where(found.seldom[..., None], found.colours, picture)
    step, at = math.ceil(math.sqrt(place.sum() / MOST)), np.argwhere(place)
    row, column = at[(at % step == 0).all(1)].T
    viewmat, K = _camera(views, key)
    points = unproject(np.stack([column, row], 1) + 0.5, inverse[row, column], viewmat, K)
    blur = BLUR - PIXEL if splats.antialias else 0  # so as to be as opaque with less blur on the screen
    sizes = step * math.sqrt(ROUND**2 + blur) / inverse[row, column] / K[0, 0]
    surface = [torch.as_tensor(part).to(splats.means) for part in (points, picture[row, column], sizes)]
    return [torch.as_tensor(found.never[row, column]).to(splats.means.device), *surface]


def _drawn(sets: Sequence[Splats], views: Views, frame: int) -> Rendering:
    """Drawn at one instant."""
    (drawn,) = Moment(sets).draw(views.camera(frame))
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

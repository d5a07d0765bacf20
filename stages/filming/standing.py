"""Where people stand whose place the film does not say: near by, in view of the clip's camera, and in nothing of the scene."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import torch

from stages.avatar.drawing.cast import Moment
from stages.avatar.rasterize import Camera
from stages.filming.setting import Setting
from stages.filming.spec import Film, Person
from stages.formats.clip import Clip

Place = tuple[float, float]

RADIUS, LOW, TALL = 0.3, 0.15, 1.8  # m: the room that somebody needs; what lies on the floor is no hindrance
APART = 0.8  # m between two people
STEP, FAR = 0.25, 2.0  # m: the places that are looked at, and how far away
DEEP = 1.5  # times as far counts a step toward the camera or away as one aside
SOLID, HOLDS = 0.5, 10  # opacity of a Gaussian that is something, and how many there may be where nobody is in the way
HIDDEN, SHOWN, SHARED = 0.05, 0.8, 0.3  # shares of somebody's room: hidden by the scene, in the picture, also another's
CLOSE = 1.4  # times as near to the camera as somebody else, at most: who is much nearer fills the picture
SMALL = 160  # px of the longer side of the picture in which that is measured


def free_places(film: Film, starts: Sequence[Place], setting: Setting) -> list[Place]:
    """Where each person of the film stands, m on the floor to the left and ahead: as said, or the nearest place that is free.

    `starts`: how far from there their motion begins. Free is where few of the scene's Gaussians are, where the camera of the
    clip's middle sees all of somebody, and nobody else stands, before or behind them either; if no place is, that where
    least is in the way. The scene's own people are where they were. Those of one clip who move as they did there stay together.
    """
    found = {i: person.at for i, person in enumerate(film.people) if person.at is not None}
    own = [i for i, person in enumerate(film.people) if person.avatar == film.scene and i not in found]
    found |= {i: (0.0, 0.0) for i in own if film.people[i].motion == "clip" or i == own[0]}
    for i, person in enumerate(film.people):
        if i not in found:
            taken = {_sum(place, starts[k]) for k, place in found.items()}
            found[i] = _beside(person, film, found) or _freest(taken, starts[i], setting)
    return [found[i] for i in range(len(film.people))]


def _sum(one: Place, other: Place) -> Place:
    return one[0] + other[0], one[1] + other[1]


def _beside(person: Person, film: Film, found: Mapping[int, Place]) -> Place | None:
    """The place of another of the same clip, if both move as they did there, and nobody is there in the person's stead."""
    others = [(film.people[k], place) for k, place in found.items() if film.people[k].avatar == person.avatar]
    moving = [(one, place) for one, place in others if one.motion == person.motion == "clip"]
    held = {place for one, place in moving if one.who == person.who}
    return next((place for _, place in moving if place not in held), None)


def _freest(taken: Collection[Place], start: Place, setting: Setting) -> Place:
    """The first place from which somebody who begins at `start` from there is free, or the one with least in the way."""
    way = STEP * np.arange(-round(FAR / STEP), round(FAR / STEP) + 1)
    spots = [(float(x), float(z)) for x in way for z in way]
    spots.sort(key=lambda spot: (round(float(np.hypot(spot[0], DEEP * spot[1])), 6), -spot[0], -spot[1]))
    if not taken:
        return spots[0]  # where the scene's own person stood, whatever training left there
    least, best = np.inf, spots[0]
    for spot in spots:
        x, z = _sum(spot, start)
        if all(np.hypot(x - a, z - b) >= APART for a, b in taken):
            in_the_way = _in_the_way((x, z), taken, setting, least)
            if in_the_way < least:
                least, best = in_the_way, spot
        if least <= 1:
            break
    return best


def _in_the_way(spot: Place, taken: Collection[Place], setting: Setting, least: float) -> float:
    """How much is where somebody would stand, or between them and the camera: 1 is just free; from `least` on any number."""
    solid = 0.0
    if setting.scene is not None:
        x, y, z = ((setting.scene.means - setting.ground.point) @ setting.ground.turn).T
        there = (np.hypot(x - spot[0], z - spot[1]) < RADIUS) & (y > LOW) & (y < TALL)
        solid = float((there & (setting.scene.opacities > SOLID)).sum() / HOLDS)
    if setting.clip is None:
        return solid
    view, K, size = _camera(setting.clip)
    (low, high), near = box = _box(spot, view, K, setting)
    inside = np.clip([low, high], 0, size)
    shown = float(np.prod(inside[1] - inside[0]) / np.prod(high - low))
    if near < RADIUS or shown == 0:
        return np.inf
    others = [one for one in (_box(place, view, K, setting) for place in taken) if one[1] >= RADIUS]
    shared = max((_overlap(box[0], other) for other, _ in others), default=0.0)
    nearer = min((away for _, away in others), default=near) / near
    found = max(solid, (1 - shown) / (1 - SHOWN), shared / SHARED, nearer / CLOSE)
    return found if found >= least else max(found, _hidden(inside, near, view, K, size, setting) / HIDDEN)


def _camera(clip: Clip) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """View matrix, intrinsics and size of the clip's middle frame, as a small picture."""
    middle, ratio = len(clip.names) // 2, SMALL / max(clip.width, clip.height)
    size = [round(ratio * clip.width), round(ratio * clip.height)]
    return clip.viewmats[middle], np.diag([ratio, ratio, 1]) @ clip.Ks[middle], size


def _box(spot: Place, view: np.ndarray, K: np.ndarray, setting: Setting) -> tuple[np.ndarray, float]:
    """Corners [2,2] px of the room of somebody at the `spot`, and how near to the camera it comes, m."""
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    rim = [(spot[0] + RADIUS * np.cos(a), y, spot[1] + RADIUS * np.sin(a)) for a in angles for y in (0.0, TALL)]
    points = (np.array(rim) @ setting.ground.turn.T + setting.ground.point) @ view[:3, :3].T + view[:3, 3]
    pixels = points[:, :2] / np.maximum(points[:, 2:], RADIUS) * K[[0, 1], [0, 1]] + K[:2, 2]
    return np.array([pixels.min(0), pixels.max(0)]), float(points[:, 2].min())


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the smaller of two boxes [2,2] that lies in the other."""
    across = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
    smaller = min(np.prod(box[1] - box[0]) for box in (one, other))
    return float(np.prod(np.maximum(across, 0)) / smaller)


def _hidden(box: np.ndarray, near: float, view: np.ndarray, K: np.ndarray, size: list[int], setting: Setting) -> float:
    """Share of a box [2,2] px that the scene covers nearer than `near` m."""
    if setting.splats is None:
        return 0.0
    depths = setting.splats.means @ torch.as_tensor(view[2, :3]).to(setting.splats.means) + view[2, 3]
    before = setting.splats.rows(depths < near)
    _, alpha = Moment((), before).picture(Camera.of(view, K, *size))
    (left, top), (right, bottom) = np.floor(box[0]).astype(int), np.ceil(box[1]).astype(int)
    return float(alpha[top:bottom, left:right].mean())

"""Where people stand whose place the film does not say: near by, in view of the clip's camera all along its way, and in nothing of
the scene.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from stages.avatar.cameras.pinhole import onto
from stages.avatar.rasterize import Camera
from stages.avatar.splats.compose import depths
from stages.filming.setting import Setting
from stages.filming.spec import Film, Person
from stages.formats.images import evenly
from stages.records import Ground

Place = tuple[float, float]

RADIUS, LOW, TALL = 0.3, 0.15, 1.8  # m: the room that somebody needs; what lies on the floor is no hindrance
APART = 0.8  # m between two people
STEP, FAR = 0.25, 2.0  # m: the places that are looked at, and how far away
DEEP = 1.5  # times as far counts a step toward the camera or away as one aside
SOLID, HOLDS = 0.5, 10  # opacity of a Gaussian that is something, and how many there may be where nobody is in the way
HIDDEN, SHOWN, SHARED = 0.05, 0.8, 0.3  # shares of somebody's room: hidden by the scene, in the picture, also another's
CLOSE = 1.4  # times as near to the camera as somebody else, at most: who is much nearer fills the picture
FRAMES, SMALL = 5, 160  # of the clip that are looked at, and px of the longer side of the pictures
THERE = 0.5  # coverage from which a pixel shows something


class View(NamedTuple):
    """A frame of the clip as a small picture: viewmat [4,4], K [3,3], and the scene's `depth` [H,W] m, inf where nothing is."""

    viewmat: np.ndarray
    K: np.ndarray
    depth: np.ndarray


def free_places(film: Film, starts: Sequence[Place], setting: Setting) -> list[Place]:
    """Where each person of the film stands, m on the floor to the left and ahead: as said, or the nearest place that is free.

    `starts`: how far from there their motion begins. Free is where few of the scene's Gaussians are, where the clip's camera, all
    along its way or, in a film by a `still` one, in the middle, sees all of somebody, and nobody else stands, before or behind them
    either; if no place is, that where least is in the way. The scene's own people are where they were. Those of one clip who move
    as they did there stay together.
    """
    found = {i: person.at for i, person in enumerate(film.people) if person.at is not None}
    own = [i for i, person in enumerate(film.people) if person.avatar == film.scene and i not in found]
    found |= {i: (0.0, 0.0) for i in own if film.people[i].motion == "clip" or i == own[0]}

    @cache
    def views() -> list[View]:
        return views_of(setting, 1 if film.camera == "still" else FRAMES)

    for i, person in enumerate(film.people):
        if i not in found:
            taken = {_sum(place, starts[k]) for k, place in found.items()}
            place = _beside(person, film, found)
            # where nobody is, where the scene's own person stood, whatever training left there
            found[i] = place or (_freest(taken, starts[i], setting, views()) if taken else (0.0, 0.0))
    return [found[i] for i in range(len(film.people))]


def views_of(setting: Setting, count: int) -> list[View]:
    """`count` frames of the scene's clip, spread evenly, one: its middle one; none without a clip."""
    clip, found = setting.clip, []
    if clip is None:
        return []
    ratio = SMALL / max(clip.width, clip.height)
    width, height = round(ratio * clip.width), round(ratio * clip.height)
    for i in evenly(len(clip.names), count) if count > 1 else [len(clip.names) // 2]:
        K, depth = np.diag([ratio, ratio, 1]) @ clip.Ks[i], np.full((height, width), np.inf)
        if setting.splats is not None:
            z, _, alpha = depths(setting.splats, Camera.of(clip.viewmats[i], K, width, height).to(setting.splats.means))
            depth = torch.where(alpha > THERE, z, torch.inf).cpu().numpy()
        found.append(View(clip.viewmats[i], K, depth))
    return found


def _sum(one: Place, other: Place) -> Place:
    return one[0] + other[0], one[1] + other[1]


def _beside(person: Person, film: Film, found: Mapping[int, Place]) -> Place | None:
    """The place of another of the same clip, if both move as they did there, and nobody is there in the person's stead."""
    others = [(film.people[k], place) for k, place in found.items() if film.people[k].avatar == person.avatar]
    moving = [(one, place) for one, place in others if one.motion == person.motion == "clip"]
    held = {place for one, place in moving if one.who == person.who}
    return next((place for _, place in moving if place not in held), None)


def _freest(taken: Collection[Place], start: Place, setting: Setting, views: Sequence[View]) -> Place:
    """The first place from which somebody who begins at `start` from there is free, or the one with least in the way."""
    way = STEP * np.arange(-round(FAR / STEP), round(FAR / STEP) + 1)
    spots = [(float(x), float(z)) for x in way for z in way]
    spots.sort(key=lambda spot: (round(float(np.hypot(spot[0], DEEP * spot[1])), 6), -spot[0], -spot[1]))
    least, best = np.inf, spots[0]
    for spot in spots:
        x, z = _sum(spot, start)
        if all(np.hypot(x - a, z - b) >= APART for a, b in taken):
            in_the_way = _in_the_way((x, z), taken, setting, views)
            if in_the_way < least:
                least, best = in_the_way, spot
        if least <= 1:
            break
    return best


def _in_the_way(spot: Place, taken: Collection[Place], setting: Setting, views: Sequence[View]) -> float:
    """How much is where somebody would stand, or between them and the camera in the mean of `views`: 1 is just free."""
    solid = 0.0
    if setting.scene is not None:
        x, y, z = ((setting.scene.means - setting.ground.point) @ setting.ground.turn).T
        there = (np.hypot(x - spot[0], z - spot[1]) < RADIUS) & (y > LOW) & (y < TALL)
        solid = float((there & (setting.scene.opacities > SOLID)).sum() / HOLDS)
    if not views:
        return solid
    seen = [_seen(spot, taken, view, setting.ground) for view in views]
    if not any(shown for shown, _ in seen):
        return np.inf
    return max(solid, *np.mean([doubts for _, doubts in seen], 0).tolist())


def _seen(spot: Place, taken: Collection[Place], view: View, ground: Ground) -> tuple[bool, tuple[float, ...]]:
    """Whether a frame shows somebody at the `spot`, and how much of them it cuts off and others share, how much nearer they are,
    and how much of them the scene hides: each in parts of what is allowed.
    """
    (low, high), near = box = _box(spot, view, ground)
    inside = np.clip([low, high], 0, view.depth.shape[::-1])
    shown = float(np.prod(inside[1] - inside[0]) / np.prod(high - low)) if near >= RADIUS else 0.0
    if shown == 0:
        return False, (1 / (1 - SHOWN), 0.0, 0.0, 0.0)
    others = [one for one in (_box(place, view, ground) for place in taken) if one[1] >= RADIUS]
    shared = max((_overlap(box[0], other) for other, _ in others), default=0.0)
    nearer = min((away for _, away in others), default=near) / near
    (left, top), (right, bottom) = np.floor(inside[0]).astype(int), np.ceil(inside[1]).astype(int)
    hidden = float((view.depth[top:bottom, left:right] < near).mean())
    return True, ((1 - shown) / (1 - SHOWN), shared / SHARED, nearer / CLOSE, hidden / HIDDEN)


def _box(spot: Place, view: View, ground: Ground) -> tuple[np.ndarray, float]:
    """Corners [2,2] px of the room of somebody at the `spot`, and how near to the camera it comes, m."""
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    rim = [(spot[0] + RADIUS * np.cos(a), y, spot[1] + RADIUS * np.sin(a)) for a in angles for y in (0.0, TALL)]
    points = (np.array(rim) @ ground.turn.T + ground.point) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    pixels = onto(points, view.K, RADIUS)
    return np.array([pixels.min(0), pixels.max(0)]), float(points[:, 2].min())


def _overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the smaller of two boxes [2,2] that lies in the other."""
    across = np.minimum(one[1], other[1]) - np.maximum(one[0], other[0])
    smaller = min(np.prod(box[1] - box[0]) for box in (one, other))
    return float(np.prod(np.maximum(across, 0)) / smaller)

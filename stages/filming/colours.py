"""Matching people to the exposure and tint of another scene, by what the neutral places of both clips show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.drawing.cast import Moment
from stages.avatar.rasterize import Camera
from stages.avatar.splats.gaussians import Splats
from stages.formats.clip import Clip
from stages.formats.images import evenly, shrink
from stages.records import Ground

FRAMES, SIDE = 16, 120  # of a clip that are looked at, and their longer side in px
DARK, BRIGHT = 20, 250  # of 255: beyond, a camera tells no colour
FEW = 1000  # pixels from which a clip can be measured
NEUTRAL = 0.2  # of a log ratio to green: standard deviation of what counts as neutral
GREY = 0.1  # of all pixels: so many more are taken to be grey, as cameras balance white
STEPS = 30
WHITE = (
    0.9  # of neutral places are darker than what tells the exposure: rooms differ less in their whites than on average
)
DOUBT_EXPOSURE, DOUBT_TINT = 0.12, 0.18  # log: what rooms of like paint differ by
FEW_NEUTRAL, MANY_NEUTRAL = (
    0.2,
    0.4,
)  # the share of neutral places up to which a clip knows nothing, and from which it is sure
PLAIN, COLOURFUL = 0.08, 0.15  # likewise of the spread of its colours, log
MOST_EXPOSURE, MOST_TINT = (0.6, 1.6), (0.82, 1.22)
"""Limits of what people's colours are multiplied by: of all light, and of red or blue beside green."""
LEAST = 1e-3  # sureness: with less, nothing is believed
EYE, AROUND = 1.5, 8  # m and views: how a scene without a clip is looked at


class Look(NamedTuple):
    """How a clip shows neutral places: log `exposure`, of the white ones, and log `tint` [2] of red and blue beside green.

    `sure`, 0 to 1, is how far they can be told from coloured ones: little where few are near neutral, as on a lawn, and where
    all is of one colour, as before a wall.
    """

    exposure: float
    tint: np.ndarray
    sure: float


def look_of(pixels: np.ndarray) -> Look | None:
    """The look of pixels uint8 [N,3]; None where too few are neither dark nor clipped.

    Places count the less, the farther their colour is from neutral, which is where most of those near grey are (mean shift,
    from grey and drawn to it).
    """
    clear = (pixels.min(1) >= DARK) & (pixels.max(1) <= BRIGHT)
    if clear.sum() < FEW:
        return None
    logs = np.log(pixels[clear] / 255)
    ratios, tint = logs[:, [0, 2]] - logs[:, [1]], np.zeros(2)
    for _ in range(STEPS):
        weight = np.exp(-0.5 * ((ratios - tint) ** 2).sum(1) / NEUTRAL**2)
        tint = weight @ ratios / (weight.sum() + GREY * len(ratios))
    light = logs.mean(1)
    order = light.argsort()
    white = np.searchsorted(weight[order].cumsum(), WHITE * weight.sum())
    spread = np.sqrt(ratios.var(0).mean())
    sure = np.interp(weight.mean(), [FEW_NEUTRAL, MANY_NEUTRAL], [0, 1]) * np.interp(spread, [PLAIN, COLOURFUL], [0, 1])
    return Look(float(light[order[white]]), tint, float(sure))


def look_of_clip(clip: Clip) -> Look | None:
    """The look of a clip's frames beside the person."""
    found = []
    for i in evenly(len(clip.names), FRAMES):
        picture, mask = shrink(clip.images(i), SIDE), np.repeat(clip.mask(i)[..., None], 3, 2)
        found.append(picture[shrink(mask, SIDE)[..., 0] < 64])
    return look_of(np.concatenate(found))


def look_of_scene(scene: Splats, ground: Ground) -> Look | None:
    """The look of a scene without a clip, as people see it who stand on its floor and turn around."""
    eye = ground.point + EYE * ground.up
    K, found = pinhole(0.5 * SIDE, SIDE, SIDE), []
    for angle in np.linspace(0, 2 * np.pi, AROUND, endpoint=False):
        way = ground.turn @ np.array([np.sin(angle), 0, np.cos(angle)])
        image, alpha = Moment((), scene).picture(Camera.of(look_at(eye, eye + way, ground.up), K, SIDE, SIDE))
        found.append(np.rint(image.clip(0, 1) * 255)[alpha > 0.95])
    return look_of(np.concatenate(found))


def gain_between(own: Look, there: Look, always: bool) -> np.ndarray:
    """What colours [3] of a person of one look are multiplied by in a scene of another, within MOST_EXPOSURE and MOST_TINT.

    Unless `always`, differences that the rooms themselves may have count for nothing, and twice as large ones in full (firm
    shrinkage, Gao and Bruce 1997): it then never errs by more than no gain does, as long as the rooms differ by no more. The
    less `sure` one of the looks is, the larger a difference must be.
    """
    light, tint = np.array(there.exposure - own.exposure), there.tint - own.tint
    if not always:
        doubt = 1 / max(min(own.sure, there.sure), LEAST)
        light, tint = _firm(light, doubt * DOUBT_EXPOSURE), _firm(tint, doubt * DOUBT_TINT)
    light, tint = np.log(np.exp(light).clip(*MOST_EXPOSURE)), np.log(np.exp(tint).clip(*MOST_TINT))
    ratios = np.array([tint[0], 0, tint[1]])
    return np.exp(light + ratios - ratios.mean())


def match(own: Look | None, there: Look | None, always: bool) -> tuple[np.ndarray, str]:
    """What colours [3] of a person are multiplied by, and how to say so after their name."""
    if own is None or there is None:
        return np.ones(3), f"colours are unchanged: {'their clip' if own is None else 'the scene'} cannot be measured"
    gain = gain_between(own, there, always)
    if abs(gain - 1).max() > 0.005:
        return gain, f"red, green and blue times {', '.join(f'{part:.2f}' for part in gain)}"
    if always or min(own.sure, there.sure) == 1:
        return np.ones(3), "colours are unchanged: the clips differ no more than rooms do"
    where = "their clip" if own.sure < there.sure else "the scene"
    return np.ones(3), f"colours are unchanged: {where} has too few neutral places to measure its light"


def _firm(value: np.ndarray, doubt: float) -> np.ndarray:
    return np.sign(value) * np.minimum(np.abs(value), 2 * np.maximum(0, np.abs(value) - doubt))

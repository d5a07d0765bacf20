"""Clips in which a person is not on the floor as the body fit expects: tables, stairs, slopes, boards, jumps, chairs.

The true body stands in for the first guess, wrong in depth as landmarks make it; a full fit of each would take ten seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from stages.avatar.body.smpl import Body
from stages.estimators.bodyfit.contact import sole_vertices
from stages.estimators.bodyfit.scale import TimedCameras, find_scale
from stages.estimators.ground import Plane
from stages.formats.body_model import read_body_model
from tests.made import bodyfit_clips
from tests.made.bodyfit_clips import Act, TrueClip
from tests.made.worlds import umeyama

MODEL = read_body_model()
FRAMES = 24
DEPTH_NOISE = 0.015
"""Share of its distance that the guessed body stands too near or too far, frame by frame."""
SOLES = 8


def limp(times: np.ndarray) -> np.ndarray:
    """The body pose [F,23,3] of `stand` with straight legs."""
    pose = bodyfit_clips.motion(times)[1].reshape(-1, 23, 3).copy()
    pose[:, [0, 1, 3, 4]] = 0
    return pose


def carried(way: Callable[[np.ndarray], np.ndarray]) -> Act:
    """An act: somebody who stands with straight legs and is carried along `way`(times) [F,3] m."""
    return lambda times: (np.zeros((len(times), 3)), limp(times).reshape(-1, 69), way(times))


def lie(times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """On the back all the time."""
    return np.tile([-np.pi / 2, 0, 0], (len(times), 1)), limp(times).reshape(-1, 69), np.zeros((len(times), 3))


def sit(times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """On no chair all the time, feet on the floor."""
    pose = limp(times)
    pose[:, [0, 1], 0], pose[:, [3, 4], 0] = -1.5, 1.5
    return np.tile([0, 0.5, 0], (len(times), 1)), pose.reshape(-1, 69), np.zeros((len(times), 3))


def on_board(times: np.ndarray) -> np.ndarray:
    """The way of somebody on a skateboard 10 cm high."""
    return np.stack([0.3 * times - 0.9, 0 * times + 0.1, 0 * times], 1)


def on_trampoline(times: np.ndarray) -> np.ndarray:
    """The way of somebody who jumps half a metre over the floor, and higher."""
    lap = (times % 1.1) / 1.1
    return np.stack([0 * times, 0.5 + 2.8 * lap * (1 - lap), 0 * times], 1)


def climb(times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Backwards up the stairs."""
    pose, swing = limp(times), np.sin(2 * np.pi * times / 1.4)
    for side, sign in ((0, 1), (1, -1)):
        lift = np.clip(sign * swing, 0, None)
        pose[:, side, 0], pose[:, 3 + side, 0] = -0.9 * lift, 1.0 * lift
    way = np.stack([0 * times, 0 * times, 0.8 - 0.25 * times], 1)
    return np.tile([0, np.pi * 0.8, 0], (len(times), 1)), pose.reshape(-1, 69), way


def stairs(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Heights of stairs that rise by 17 cm every 30."""
    return 0.17 * np.floor(np.clip(0.9 - z, 0, None) / 0.3)


def slope(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Heights of a slope of 12 degrees toward the camera."""
    return np.tan(np.radians(12)) * z


def walls(clip: TrueClip) -> np.ndarray:
    """The clip's points without those of the floor."""
    return clip.points[400:]


def table(clip: TrueClip, height: float) -> np.ndarray:
    """Points [300,3] of a table top before the legs, in the clip's SfM units."""
    rng, t = np.random.default_rng(5), clip.times
    angle = np.radians(-25 + 50 * t / 6)
    eyes = np.stack([3.2 * np.sin(angle), 1.4 + 0.1 * np.sin(3 * t), 3.2 * np.cos(angle)], 1)
    scale, turn, shift = umeyama(eyes, clip.cameras.centers)
    top = np.stack([rng.uniform(-0.8, 0.8, 300), rng.normal(height, 0.004, 300), rng.uniform(0.5, 1.4, 300)], 1)
    return scale * top @ turn.T + shift


def told(clip: TrueClip, points: np.ndarray, height: int = bodyfit_clips.HEIGHT) -> tuple[dict[str, Any], Plane | None]:
    """What `find_scale` says of the clip with SfM `points` [P,3], the scales in it over the true one; and the floor.

    `height` px of the pictures, from whose top on.
    """
    noise = 1 + DEPTH_NOISE * np.random.default_rng(1).standard_normal((FRAMES, 1, 1))
    skin = (clip.vertices.astype(np.float64) - clip.scale * clip.cameras.centers[:, None]) * noise
    up = -clip.cameras.viewmats[:, 1, :3].mean(0)
    path = TimedCameras(
        clip.cameras.viewmats, clip.cameras.Ks, clip.cameras.centers, clip.times, (bodyfit_clips.WIDTH, height)
    )
    rows = np.concatenate([sole_vertices(Body(MODEL), SOLES).numpy().ravel(), np.arange(0, len(MODEL.v_template), 40)])
    ups = up[None] / np.linalg.norm(up)
    found, floor = find_scale(path, points, skin[:, rows], SOLES, np.full(FRAMES, 400.0), ups)
    scales = ("initial", "from_still_feet", "floor_refused")
    return {key: value / clip.scale if key in scales else value for key, value in found.items()}, floor


def make(act: Act = bodyfit_clips.stand, floor=bodyfit_clips.level) -> TrueClip:
    """A clip of FRAMES frames of what `act` does on the `floor`."""
    return bodyfit_clips.make(MODEL, frames=FRAMES, betas=(0.0,), act=act, floor=floor)

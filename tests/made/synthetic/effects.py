"""Effects of a synthetic clip, which a detector should find and training should learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.cameras import lens
from stages.avatar.cameras.pinhole import camera_centers, look_at, pinhole
from stages.avatar.kernels.mesh import fill
from stages.records import BodyModel
from stages.synthetic.person import keypoints
from stages.synthetic.room import step

MOMENTS = 9
"""How many moments a blurred picture is the mean of, and at how many a rolling shutter's path is known."""
DRIFT = 0.25
"""White balance drifts by this share of the exposure's drift."""
LAMP_AWAY, MAP_SIDE, MAP_M = 100.0, 640, 3.2
"""The lamp of a shadow map is so far that its rays are parallel, m; its pixels, and how many m they show."""
SOFT, CONTACT_SOFT, CONTACT_HEIGHT = 0.02, 0.035, 0.12
"""Blur of a shadow's edge, of the dark rim of the feet, and up to where a body touches the floor, m."""


LAMPS = np.array([[0.4, 2.4, -1.7], [-1.2, 1.9, 3.2]])
"""What glossy surfaces mirror: a lamp under the ceiling and a window behind the camera, m."""
ZENITH, HAZE, CLOUD, HILL = (0.42, 0.62, 0.9), (0.8, 0.88, 0.95), (0.95, 0.95, 0.96), (0.33, 0.44, 0.3)

Moving = Callable[[float], np.ndarray]
"""Points [V,3] m in the world at a moment, in frames."""


@dataclass(frozen=True)
class ClipEffects:
    """How strong each effect is; 0 leaves it out."""

    view_dependence: float = 0.0
    """Weight of the blurred mirror on all surfaces of the room."""
    exposure: float = 0.0
    """Standard deviation of the log gain over the frames; the colours drift by a quarter of it."""
    white_balance: float = 0.0
    """Standard deviation of the log gains of the colours over the frames; brightness stays."""
    lens: float = 0.0
    """k of a SIMPLE_RADIAL lens; negative for a barrel."""
    rolling_shutter: float = 0.0
    """Time from the first to the last row, as share of the frame interval."""
    motion_blur: float = 0.0
    """How long the shutter is open, as share of the frame interval."""
    shadow: float = 0.0
    """How much darker the floor is in the person's shadow, 0..1."""
    shading: float = 0.0
    """How much brighter the side of the person is that faces a second lamp, in log: half of it more, the other side half less."""
    clothing: float = 0.0
    """Width in m of a skirt and sleeves that swing with the pose."""
    sky: float = 0.0
    """1: no back wall and no ceiling, but sky and far hills."""
    transients: float = 0.0
    """How many strangers walk through the room."""
    antialias: float = 0.0
    """Ratio of the camera's largest and smallest distance from the person."""

    def scene_only(self) -> ClipEffects:
        """Without what belongs to one recording: camera, lens, shutter, strangers."""
        return replace(
            self, exposure=0.0, white_balance=0.0, lens=0.0, rolling_shutter=0.0, motion_blur=0.0, transients=0.0
        )


NO_EFFECTS = ClipEffects()


class Course:
    """Where camera and body are at each moment, in frames: exact at whole numbers, splines between.

    `viewmats` [F,4,4] camera_from_world and `vertices` [F,V,3] m.
    """

    def __init__(self, viewmats: np.ndarray, vertices: np.ndarray):
        self.viewmats, self.vertices = viewmats, vertices

    def viewmat(self, t: float) -> np.ndarray:
        """camera_from_world [4,4] at moment `t`."""
        if t == int(t):
            return self.viewmats[int(t)]
        turns, places, middle = self._path
        matrix = np.eye(4)
        matrix[:3, :3] = (Rotation.from_rotvec(turns(t)) * middle).as_matrix()
        matrix[:3, 3] = -matrix[:3, :3] @ places(t)
        return matrix

    def body(self, t: float) -> np.ndarray:
        """Vertices [V,3] at moment `t`."""
        return self.vertices[int(t)] if t == int(t) else self._motion(t)

    @cached_property
    def _path(self) -> tuple[CubicSpline, CubicSpline, Rotation]:
        rotations, frames = Rotation.from_matrix(self.viewmats[:, :3, :3]), np.arange(len(self.viewmats))
        middle = rotations[len(frames) // 2]
        places = CubicSpline(frames, camera_centers(self.viewmats))
        return CubicSpline(frames, (rotations * middle.inv()).as_rotvec()), places, middle

    @cached_property
    def _motion(self) -> CubicSpline:
        return CubicSpline(np.arange(len(self.vertices)), self.vertices)


def sky(rays: np.ndarray) -> np.ndarray:
    """Colours [...,3] of sky, clouds and far hills along the directions `rays` [...,3], y up; all is infinitely far."""
    azimuth = np.arctan2(rays[..., 0], -rays[..., 2])
    rise = np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
    cloud = np.sin(3.1 * azimuth + 1.0) * np.sin(7.0 * rise) + 0.6 * np.sin(7.7 * azimuth - 9.0 * rise)
    height = (rise / 0.6).clip(0, 1)[..., None]
    above = np.array(HAZE) * (1 - height) + np.array(ZENITH) * height
    above = above + (np.array(CLOUD) - above) * 0.6 * step(cloud - 0.3, 1.2)[..., None]
    ridge = 0.07 + 0.03 * np.sin(4.3 * azimuth) + 0.015 * np.sin(17 * azimuth + 0.7)
    trees = np.sin(61 * azimuth + 3 * np.sin(43 * rise)) * np.sin(83 * rise + 2 * np.sin(29 * azimuth))
    hills = np.array(HILL) * (1 + 0.35 * trees)[..., None]
    cover = step(ridge - rise, 0.006)[..., None]
    return above * (1 - cover) + hills * cover


def swing(model: BodyModel, faces: np.ndarray, vertices: np.ndarray, pose: np.ndarray, width: float) -> np.ndarray:
    """What loose clothes add to `vertices` [F,V,3] in m: a skirt and sleeves `width` m wide that swing with `pose` [F,69].

    The skirt stands off by half its width and flies forward and to the side with the thighs; sleeves hang from raised arms.
    """
    places = keypoints(model)
    x, y, _ = model.v_template.T
    hip, knee = places["left_hip"][1] + 0.05, places["left_knee"][1] + 0.02
    down = ((hip - y) / (hip - knee)).clip(0, 1)
    skirt = width * down * _fade(knee - 0.03, y, 0.04) * (abs(x) < 0.4)
    along = (abs(x) - places["left_shoulder"][0]) / (places["left_elbow"][0] - places["left_shoulder"][0])
    sleeve = width * along.clip(0, 1) * (along < 1) * (y > hip)
    thighs = pose.reshape(len(pose), 23, 3)[:, :2, 0]  # about x; negative forward
    added = np.zeros_like(vertices)
    for i, posed in enumerate(vertices):
        normals = vertex_normals(torch.from_numpy(posed), torch.from_numpy(faces)).numpy()
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        level = normals * [1, 0, 1]
        flying = 0.5 + 1.5 * np.where(x > 0, -thighs[i, 0], -thighs[i, 1])
        added[i] = level * (skirt * flying)[:, None]
        under = (-normals[:, 1]).clip(0, 1) * sleeve
        added[i, :, 1] -= under
    return added


def _fade(edge: float, values: np.ndarray, width: float) -> np.ndarray:
    """0 below `edge`, 1 above, over that width."""
    return ((values - edge) / width + 0.5).clip(0, 1)


def open_times(effects: ClipEffects) -> np.ndarray:
    """Moments at which a shutter is open, in frames around the frame's own time; [0.0] without motion blur."""
    if not effects.motion_blur:
        return np.zeros(1)
    return effects.motion_blur * ((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5)


def readout_times(effects: ClipEffects, height: int) -> np.ndarray:
    """When each row [H] is read, in frames after the middle one; one time for all [1] without a rolling shutter."""
    if not effects.rolling_shutter:
        return np.zeros(1)
    return effects.rolling_shutter * ((np.arange(height) + 0.5) / height - 0.5)


def camera_points(
    course: Course, things: Moving, t: float, effects: ClipEffects, K: np.ndarray, height: int
) -> np.ndarray:
    """`things`(moment) [V,3] in coordinates of the camera at `t`, each point when the row it falls on is read."""

    def at(moment: float) -> np.ndarray:
        viewmat = course.viewmat(moment)
        return things(moment) @ viewmat[:3, :3].T + viewmat[:3, 3]

    if not effects.rolling_shutter:
        return at(t)
    nodes = np.stack([at(t + s) for s in effects.rolling_shutter * (np.linspace(0, 1, MOMENTS) - 0.5)])
    share, which = np.full(nodes.shape[1], 0.5), np.arange(nodes.shape[1])
    for _ in range(4):
        below = (share * (MOMENTS - 1)).astype(int).clip(0, MOMENTS - 2)
        part = (share * (MOMENTS - 1) - below)[:, None]
        points = nodes[below, which] * (1 - part) + nodes[below + 1, which] * part
        share = ((K[1, 1] * points[:, 1] / points[:, 2] + K[1, 2]) / height).clip(0, 1)
    return points


def gains(effects: ClipEffects, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Factors [F,3] of the colours of each frame: a drift in two slow waves, mean log gain 0."""
    if not (effects.exposure or effects.white_balance):
        return np.ones((frames, 3))
    u = np.linspace(0, 1, frames)[:, None]
    phase = rng.uniform(0, 2 * np.pi, (2, 4))
    waves = np.sin(2 * np.pi * u + phase[0]) + 0.7 * np.sin(5 * np.pi * u + phase[1])
    waves = (waves - waves.mean(0)) / waves.std(0)
    color = waves[:, 1:] - waves[:, 1:].mean(1, keepdims=True)
    tint = waves[:, 1:] - waves[:, 1:] @ [[0.299], [0.587], [0.114]]  # of grey, by BT.601's weights
    return np.exp(effects.exposure * (waves[:, :1] + DRIFT * color) + effects.white_balance * tint)


def to_linear(colors: np.ndarray) -> np.ndarray:
    """Light 0..1 of sRGB values 0..1 (IEC 61966-2-1)."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def to_srgb(light: np.ndarray) -> np.ndarray:
    """The inverse of `to_linear`."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def margin(effects: ClipEffects, K: np.ndarray, width: int, height: int) -> int:
    """Pixels around the picture that a lens looks at beyond the pinhole's view."""
    if not effects.lens:
        return 0
    reach = lens.undistort((lens.border(width, height) - K[:2, 2]) / K[0, 0], effects.lens) * K[0, 0] + K[:2, 2]
    return int(np.ceil(max(-reach.min(), (reach - [width, height]).max(), 0))) + 2


def distort(picture: np.ndarray, effects: ClipEffects, K: np.ndarray, pad: int, order: int = 1) -> np.ndarray:
    """A pinhole's `picture` [H+2pad,W+2pad,C] as the lens sees it [H,W,C]; `K` [3,3] px is that without the margin."""
    if not effects.lens:
        return picture
    height, width = picture.shape[0] - 2 * pad, picture.shape[1] - 2 * pad
    at = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    ideal = lens.undistort((at - K[:2, 2]) / K[0, 0], effects.lens) * K[0, 0] + K[:2, 2] + pad - 0.5
    x, y = ideal[..., 0], ideal[..., 1]
    channels = [map_coordinates(c, [y, x], order=order, mode="nearest") for c in np.moveaxis(picture, -1, 0)]
    return np.stack(channels, -1)


class BodyShadow:
    """How dark a body with `vertices` [V,3] m and `faces` makes what lies behind it in the light: along `light`, and
    around the feet."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, light: np.ndarray, darkness: float):
        low = vertices[:, 1] < CONTACT_HEIGHT
        self.darkness = darkness
        self.cast = _ShadowMap(vertices, faces, light, SOFT)
        self.contact = _ShadowMap(vertices, faces[low[faces].all(1)], np.array([0.0, 1.0, 1e-3]), CONTACT_SOFT)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """The factor [N] of the brightness at `points` [N,3] of the room."""
        on_floor = points[:, 1] < 0.02
        return (1 - self.darkness * self.cast(points)) * (1 - self.darkness * on_floor * self.contact(points))


class _ShadowMap:
    """A shadow map: how much of the light towards a point a body takes, its edge blurred by `soft` m."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, light: np.ndarray, soft: float):
        center = np.array([0.0, 0.8, 0.0])
        self.viewmat = look_at(center + LAMP_AWAY * light / np.linalg.norm(light), center, np.array([0.0, 0.0, -1.0]))
        focal = MAP_SIDE / MAP_M * LAMP_AWAY
        self.K = pinhole(focal, MAP_SIDE, MAP_SIDE)
        depth, face, _ = fill(self._seen(vertices), faces, self.K, MAP_SIDE, MAP_SIDE)
        self.nearest = depth.min()
        self.cover = gaussian_filter((face >= 0).astype(float), soft * MAP_SIDE / MAP_M)

    def _seen(self, points: np.ndarray) -> np.ndarray:
        return points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        seen = self._seen(points)
        x, y = (self.K[i, i] * seen[:, i] / seen[:, 2] + self.K[i, 2] - 0.5 for i in (0, 1))
        return map_coordinates(self.cover, [y, x], order=1, mode="constant") * (seen[:, 2] > self.nearest)

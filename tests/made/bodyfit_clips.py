"""A body that moves before a moving camera, and the landmarks a BlazePose would give of it; all from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch

from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import look_at, pinhole, project
from stages.estimators.bodyfit import fit
from stages.estimators.bodyfit.evidence import NAMES, STAND_INS, model_landmarks
from stages.estimators.bodyfit.scale import SOLE
from stages.records import BodyModel, Cameras, SeenLandmarks

WIDTH, HEIGHT, FOCAL = 480, 864, 760.0
SFM_FROM_WORLD = 2.7  # SfM units per metre

Act = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""global_orient [F,3], body_pose [F,69] and way [F,3] m at times [F] s. The lowest of the body stands on the floor there, and
the way's y higher."""


@dataclass
class TrueClip:
    """World: metres, y up, bare feet at y = 0 and the floor a sole lower, but SfM has other axes and units."""

    model: BodyModel
    cameras: Cameras
    times: np.ndarray
    joints: np.ndarray  # [F,24,3] m, SfM axes
    vertices: np.ndarray  # [F,V,3] m, SfM axes
    tracks: list[SeenLandmarks | None]
    points: np.ndarray
    scale: float  # metres per SfM unit

    def masks(self) -> list[np.ndarray]:
        out = []
        for i, vertices in enumerate(self.vertices):
            view = self.cameras.viewmats[i].copy()
            view[:3, 3] *= self.scale
            pixels, _ = project(vertices.astype(np.float64), view, self.cameras.Ks[i])
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            for triangle in np.rint(pixels[self.model.faces] * 16 - 8).astype(np.int32):
                cv2.fillConvexPoly(mask, triangle, 255, shift=4)
            out.append(mask)
        return out


def motion(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root yaw [F] and body pose [F,69]: stands and waves, lifts the left knee, then turns a quarter."""
    pose = np.zeros((len(times), 23, 3))
    wave = np.sin(2 * np.pi * times / 1.7)
    pose[:, 15, 2], pose[:, 16, 2] = -0.5 + 0.7 * wave, 0.6 - 0.7 * wave  # shoulders, up and down
    pose[:, 15, 1], pose[:, 16, 1] = -0.3, 0.3
    pose[:, 17, 1], pose[:, 18, 1] = -0.6 - 0.4 * wave, 0.9 + 0.5 * np.cos(2 * np.pi * times / 1.3)
    lift = np.clip(np.sin(2 * np.pi * (times - 1.5) / 3), 0, None) * (times > 1.5) * (times < 3)
    pose[:, 0, 0], pose[:, 3, 0] = -0.9 * lift, 1.2 * lift
    pose[:, 14, 1] = 0.3 * wave
    yaw = np.pi / 2 * np.clip((times - 3.5) / 1.2, 0, 1)
    return yaw, pose.reshape(len(times), 69)


def stand(times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`motion` on the spot."""
    yaw, pose = motion(times)
    return np.stack([0 * yaw, yaw, 0 * yaw], -1), pose, np.zeros((len(times), 3))


def level(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """A floor at y = 0."""
    return 0 * x


def take_steps(patch: pytest.MonkeyPatch, first: int, outlined: int, last: int) -> None:
    """Let a body fit take so many steps on landmarks, then outlines too, then feet and scale as well."""
    for name, steps in (("FIRST", first), ("OUTLINED", outlined), ("LAST", last)):
        patch.setattr(fit, name, steps)


def make(
    model: BodyModel,
    frames: int = 40,
    moving: bool = True,
    noise_px: float = 3.0,
    betas=(0.6, -0.8),
    seed: int = 0,
    act: Act = stand,
    floor: Callable[[np.ndarray, np.ndarray], np.ndarray] = level,
) -> TrueClip:
    """Landmarks with noise, 3 cm in depth, 3 swapped frames, a gap of 2 and 4 % outliers.

    `act` is what the person does, and `floor` (x, z) the height of what they stand on.
    """
    rng = np.random.default_rng(seed)
    times = np.sort(np.linspace(0, 6, frames) + rng.uniform(-0.02, 0.02, frames))
    orient, pose, way = act(times)
    shape = torch.zeros(10)
    shape[: len(betas)] = torch.tensor(betas)
    f32 = lambda a: torch.tensor(a, dtype=torch.float32)  # noqa: E731
    vertices, joints = (x.numpy() for x in Body(model)(shape, f32(orient), f32(pose), f32(way * [1, 0, 1])))
    drop = (vertices[..., 1] - floor(vertices[..., 0], vertices[..., 2])).min(1) - way[:, 1].astype(np.float32)
    vertices[..., 1] -= drop[:, None]
    joints[..., 1] -= drop[:, None]
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    scale = 1 / SFM_FROM_WORLD if moving else 1.0
    viewmats = []
    for i, t in enumerate(times):
        angle = np.radians(-25 + 50 * t / 6) * moving
        eye = np.array([3.2 * np.sin(angle), 1.4 + moving * 0.1 * np.sin(3 * t), 3.2 * np.cos(angle)])
        view = look_at(eye, np.array([0, 0.9, 0.0]), np.array([0, 1.0, 0]))
        if not moving and i == 0:
            turn = view[:3, :3]  # the frame of the one camera is the world
        viewmats.append(view)
    viewmats = np.array(viewmats)
    origin = np.zeros(3) if moving else -viewmats[0, :3, :3].T @ viewmats[0, :3, 3]
    vertices, joints = ((x - origin) @ turn.T for x in (vertices, joints))
    viewmats[:, :3, 3] += viewmats[:, :3, :3] @ origin
    viewmats[:, :3, :3] = viewmats[:, :3, :3] @ turn.T
    sfm = viewmats.copy()
    sfm[:, :3, 3] /= scale
    K = pinhole(FOCAL, WIDTH, HEIGHT)
    cameras = Cameras(tuple(f"{i:06d}" for i in range(frames)), sfm, np.tile(K, (frames, 1, 1)), WIDTH, HEIGHT)
    ground = np.stack([rng.uniform(-2, 2, 400), rng.normal(-SOLE, 0.01, 400), rng.uniform(-2, 2, 400)], -1)
    ground[:, 1] += floor(ground[:, 0], ground[:, 2])
    wall = np.stack([rng.uniform(-3, 3, 600), rng.uniform(0, 2.5, 600), rng.normal(-2.2, 0.01, 600)], -1)
    points = (np.concatenate([ground, wall]) - origin) @ turn.T / scale if moving else np.zeros((0, 3))
    tracks = _tracks(model, vertices, viewmats, K, noise_px, rng)
    return TrueClip(model, cameras, times, joints, vertices, tracks, points, scale)


def _tracks(model, vertices, viewmats, K, noise_px, rng) -> list[SeenLandmarks | None]:
    names, regressor = model_landmarks(model)
    landmarks = regressor @ vertices
    pixels, _ = project(landmarks, viewmats, K)
    in_camera = landmarks @ viewmats[:, :3, :3].mT
    hips = [names.index("left_hip"), names.index("right_hip")]
    relative = in_camera - in_camera[:, hips].mean(1, keepdims=True)
    mirror = [NAMES.index(_other(name)) for name in NAMES]
    tracks: list[SeenLandmarks | None] = []
    for i in range(len(vertices)):
        xy, world, visibility = np.zeros((33, 2)), np.zeros((33, 3)), np.zeros(33)
        for k, name in enumerate(names):
            for source in STAND_INS.get(name, (name,)):
                j = NAMES.index(source)
                bad = rng.random() < 0.04
                xy[j] = pixels[i, k] + rng.normal(0, 80 if bad else noise_px, 2)
                world[j] = relative[i, k] + rng.normal(0, [0.02, 0.02, 0.05])
                visibility[j] = rng.uniform(0.6, 1)
        if i in (7, 8, 20):
            xy, world = xy[mirror], world[mirror]
        tracks.append(None if i in (13, 14) else SeenLandmarks(xy, visibility, world))
    return tracks


def _other(name: str) -> str:
    swapped = name.replace("left", "#").replace("right", "left").replace("#", "right")
    return swapped if swapped in NAMES else name

"""A clip whose truth is known: a dressed body moves in a textured room before a hand-held camera, all from one seed.

The world is in metres with y up, the floor at y = 0 and the person at the origin. Cameras have OpenCV axes and are
exact pinholes; the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from stages.avatar.body.smpl import Body, vertex_normals
from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.kernels.mesh import NO_LAMPS, cast, fill
from stages.records import BodyModel
from stages.synthetic import person
from stages.synthetic.room import Room, make_room

SUPERSAMPLE = 2
DISTANCE, ARC = 2.75, 1.0
"""The camera's distance from the person in m, and the angle of its path around them in rad."""
FOCAL = 0.95
"""Focal length in image heights: a field of view of 56 degrees."""
LIGHT = np.array([0.3, 0.9, 0.32]) / np.linalg.norm([0.3, 0.9, 0.32])
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class TrueViews:
    """V pictures of the person, and the truth about them.

    `images` [V,H,W,3] and `masks` [V,H,W] uint8 (255 = person, soft edges), `depths` [V,H,W] float32 z in metres at
    the pixel centres, `viewmats` [V,4,4] camera_from_world, `Ks` [V,3,3] px, `global_orient` [V,3], `body_pose` [V,69]
    rad, `transl` [V,3] m, `joints` [V,24,3] m in the world.
    """

    images: np.ndarray
    masks: np.ndarray
    depths: np.ndarray
    viewmats: np.ndarray
    Ks: np.ndarray
    global_orient: np.ndarray
    body_pose: np.ndarray
    transl: np.ndarray
    joints: np.ndarray

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class SyntheticClip:
    """The clip's `frames`, further views in `novel` poses that no frame shows, the body's `betas` [10], frame rate."""

    frames: TrueViews
    novel: TrueViews
    betas: np.ndarray
    fps: float


def make_clip(
    model: BodyModel,
    *,
    seed: int = 0,
    width: int = 384,
    height: int = 512,
    frames: int = 60,
    fps: float = 12.0,
    done: Callable[[int, int], None] = lambda done, total: None,
) -> SyntheticClip:
    """Make the clip of that seed; the same arguments give the same bytes.

    `model` has keypoints. `done` hears of pictures made and their number.
    """
    rng = np.random.default_rng(seed)
    room, betas = make_room(rng), rng.uniform(-0.8, 0.8, 10)
    renderer = Renderer(model, room, betas, pinhole(FOCAL * height, width, height))
    viewmats = camera_path(frames, fps, rng)
    orient, pose = person.make_motion(frames, fps, rng)
    novel_orient, novel_pose = person.novel_poses()
    beside = novel_cameras(len(novel_pose))
    total = frames + len(novel_pose)
    clip = renderer.views(viewmats, orient, pose, width, height, lambda n: done(n, total))
    novel = renderer.views(beside, novel_orient, novel_pose, width, height, lambda n: done(frames + n, total))
    return SyntheticClip(clip, novel, betas, fps)


def camera_path(frames: int, fps: float, rng: np.random.Generator) -> np.ndarray:
    """viewmats [F,4,4] of a hand-held camera that goes around the origin."""
    u, shake = np.linspace(-0.5, 0.5, frames), tremor(frames, fps, rng)
    angle, roll = ARC * u, 0.008 * shake[:, 6]
    eye = np.stack([DISTANCE * np.sin(angle), 1.35 + 0.12 * np.sin(2.5 * u), DISTANCE * np.cos(angle)], 1)
    eye[:, 2] -= 0.15 * np.cos(np.pi * u)
    eye, target = eye + 0.01 * shake[:, :3], [0, 0.93, 0] + 0.012 * shake[:, 3:6]
    up = UP + np.stack([np.sin(roll) * np.cos(angle), 0 * roll, -np.sin(roll) * np.sin(angle)], 1)
    return np.stack([look_at(*view) for view in zip(eye, target, up)])


def novel_cameras(count: int) -> np.ndarray:
    """viewmats [count,4,4] along the camera's arc, a little higher, lower and farther than it is there."""
    views = []
    for i, angle in enumerate(np.linspace(-0.42, 0.42, count) * ARC):
        distance, lift = DISTANCE * (1.0 + 0.03 * (i % 2)), 0.08 * (-1) ** i
        eye = np.array([distance * np.sin(angle), 1.35 + lift, distance * np.cos(angle)])
        views.append(look_at(eye, np.array([0, 0.94, 0]), UP))
    return np.stack(views)


def tremor(frames: int, fps: float, rng: np.random.Generator) -> np.ndarray:
    """Seven courses [F,7] of a hand's tremor, each the sum of three tones."""
    t = np.arange(frames) / fps

    def tones() -> list[tuple[float, float]]:  # Hz, phase
        return [(f * rng.uniform(0.8, 1.25), rng.uniform(0, 2 * np.pi)) for f in (0.4, 1.1, 2.3)]

    return np.stack([sum(np.sin(2 * np.pi * f * t + p) / f for f, p in tones()) for _ in range(7)], 1)


@dataclass
class Renderer:
    """Draws room and person; holds everything that does not change from picture to picture."""

    model: BodyModel
    room: Room
    betas: np.ndarray
    K: np.ndarray

    def __post_init__(self) -> None:
        self.body = Body(self.model, dtype=torch.float64)
        self.faces = np.ascontiguousarray(self.model.faces, dtype=np.int64)
        self.rest = np.asarray(self.model.v_template, np.float64)
        self.clothes = person.Outfit(self.model)

    def views(
        self,
        viewmats: np.ndarray,
        orient: np.ndarray,
        pose: np.ndarray,
        width: int,
        height: int,
        done: Callable[[int], None],
    ) -> TrueViews:
        """Draw the person in each pose, over the origin, from its camera."""
        transl, vertices, joints = person.pose_body(self.body, self.betas, orient, pose)
        drawn = []
        for i, (viewmat, skin) in enumerate(zip(viewmats, vertices)):
            image, mask = self._draw(viewmat, skin, width, height)
            near = [layer[0] for layer in self._seen(viewmat, skin, self.K, width, height)]
            drawn.append((image, mask, np.minimum(*near).astype(np.float32)))
            done(i + 1)
        images, masks, depths = (np.stack(kind) for kind in zip(*drawn))
        Ks = np.broadcast_to(self.K, (len(viewmats), 3, 3)).copy()
        return TrueViews(images, masks, depths, viewmats, Ks, orient, pose, transl, joints)

    def _draw(
        self, viewmat: np.ndarray, vertices: np.ndarray, width: int, height: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Image [H,W,3] and mask [H,W], uint8."""
        more = SUPERSAMPLE
        fine = self.K * np.array([[more], [more], [1]])
        (far, colors), (depth, face, weights) = self._seen(viewmat, vertices, fine, width * more, height * more)
        seen = depth < far
        corners, blend = self.faces[face[seen]], weights[seen][..., None]
        normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(self.faces)).numpy()
        normal = (normals[corners] * blend).sum(1)
        facing = normal @ LIGHT / np.linalg.norm(normal, axis=1)
        color = self.clothes((self.rest[corners] * blend).sum(1))
        colors[seen] = color * (0.66 + 0.34 * (0.5 + 0.5 * facing))[:, None]
        return shrink(colors.clip(0, 1) * 255, more), shrink(seen[..., None] * 255.0, more)[..., 0]

    def _seen(
        self, viewmat: np.ndarray, vertices: np.ndarray, K: np.ndarray, width: int, height: int
    ) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Of the room z [H,W] in m and colours; of the body z, faces and their weights."""
        room, pose = self.room, np.linalg.inv(viewmat)[None]
        colors, depth = cast(pose, K, width, height, room.boxes, room.paint, room.tints, room.mips, room.per_metre,
                             LIGHT, 0.0, NO_LAMPS, False)  # fmt: skip
        return (depth, colors), fill(vertices @ viewmat[:3, :3].T + viewmat[:3, 3], self.faces, K, width, height)


def shrink(fine: np.ndarray, by: int) -> np.ndarray:
    """Mean of each block of `by` x `by` pixels of [H,W,C], as uint8."""
    total = sum(fine[i::by, j::by] for i in range(by) for j in range(by))
    return np.rint(total / by**2).astype(np.uint8)

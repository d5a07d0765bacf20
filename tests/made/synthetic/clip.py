"""The synthetic clip with effects, garments and other camera paths: what detectors should find and training should learn.

It is the clip of `stages.synthetic.clip`, to the bit, where nothing of that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.kernels.mesh import cast, fill
from stages.records import BodyModel
from stages.synthetic import clip as plain
from stages.synthetic import person
from stages.synthetic.clip import (
    ARC,
    DISTANCE,
    FOCAL,
    LIGHT,
    SUPERSAMPLE,
    UP,
    SyntheticClip,
    TrueViews,
    novel_cameras,
    shrink,
    tremor,
)
from stages.synthetic.room import Room, make_room
from tests.made.synthetic.cloth import Poses, settled, worn
from tests.made.synthetic.effects import (
    LAMPS,
    NO_EFFECTS,
    BodyShadow,
    ClipEffects,
    Course,
    Moving,
    camera_points,
    distort,
    gains,
    margin,
    open_times,
    readout_times,
    sky,
    swing,
    to_linear,
    to_srgb,
)
from tests.made.synthetic.garments import Garment
from tests.made.synthetic.passers import Passer, make_passers
from tests.made.synthetic.wardrobe import make_garments

NEAR_WALL = 1.15
"""Where a camera that changes its distance begins, as share of DISTANCE: a little before the wall behind it."""
SIDE_LIGHT = np.array([0.8, 0.6, 0.0])  # of the second lamp, see ClipEffects.shading

CameraPath = Literal["moving", "static", "rotating"]


def make_clip(
    model: BodyModel,
    *,
    seed: int = 0,
    width: int = 384,
    height: int = 512,
    frames: int = 60,
    fps: float = 12.0,
    camera: CameraPath = "moving",
    effects: ClipEffects = NO_EFFECTS,
    wears: Sequence[str] = (),
    novel: int | None = None,
    done: Callable[[int, int], None] = lambda done, total: None,
) -> SyntheticClip:
    """Make the clip of that seed; the same arguments give the same bytes.

    `model` has keypoints. `camera`: "moving" goes around the person, "rotating"
    only turns, "static" stands. `effects` change the pictures and nothing that is drawn at random; novel views have those
    of the scene and the person, and none of the recording. `wears` names garments that swing, rows of
    `wardrobe.MAKERS`; in novel poses they have come to rest. Of these only the first `novel` are drawn, where it is given.
    Depths and masks are those of room and person at the frame's own time, masks blurred as the pictures are. `done` hears
    of pictures made and their number.
    """
    (room, rng), apart = room_of(seed), np.random.default_rng([seed, 1])  # effects change nothing else
    betas = rng.uniform(-0.8, 0.8, 10)
    garments = make_garments(wears, model, betas, np.random.default_rng([seed, 2]))
    renderer = Renderer(model, room, betas, pinhole(FOCAL * height, width, height), effects, garments=garments)
    viewmats = camera_path(frames, fps, camera, rng, effects.antialias)
    orient, pose = person.make_motion(frames, fps, rng)
    novel_orient, novel_pose = (part[:novel] for part in person.novel_poses())
    beside = novel_cameras(len(novel_pose))
    total = frames + len(novel_pose)
    passers = make_passers(round(effects.transients), frames, apart)
    gain = gains(effects, frames, apart)
    clip = renderer.views(viewmats, orient, pose, width, height, lambda n: done(n, total), passers, gain, fps=fps)
    plain = replace(renderer, effects=effects.scene_only())
    others = plain.views(beside, novel_orient, novel_pose, width, height, lambda n: done(frames + n, total))
    return SyntheticClip(clip, others, renderer.betas, fps)


@lru_cache(maxsize=2)
def _room(seed: int) -> tuple[Room, Mapping[str, Any]]:
    rng = np.random.default_rng(seed)
    return make_room(rng), rng.bit_generator.state


def room_of(seed: int) -> tuple[Room, np.random.Generator]:
    """The room of a seed, made once a process, and the generator as it is after it."""
    (room, state), rng = _room(seed), np.random.default_rng()
    rng.bit_generator.state = state
    return room, rng


def camera_path(
    frames: int, fps: float, motion: CameraPath, rng: np.random.Generator, range_ratio: float = 0.0
) -> np.ndarray:
    """viewmats [F,4,4] of a hand-held camera that goes around the origin, or only turns, or stands still.

    With `range_ratio` > 1 it comes nearer by that factor in the middle of the clip.
    """
    u, shake = np.linspace(-0.5, 0.5, frames), tremor(frames, fps, rng)
    still = np.zeros((frames, 3))
    angle = ARC * u if motion == "moving" else np.zeros(frames)
    eye = np.stack([DISTANCE * np.sin(angle), 1.35 + 0.12 * np.sin(2.5 * u), DISTANCE * np.cos(angle)], 1)
    eye[:, 2] -= 0.15 * np.cos(np.pi * u) if motion == "moving" else 0
    eye = eye + 0.01 * shake[:, :3] if motion == "moving" else np.broadcast_to([0, 1.35, DISTANCE], still.shape)
    if range_ratio:
        eye = eye * (NEAR_WALL * range_ratio ** (-(np.sin(np.pi * (u + 0.5)) ** 2)))[:, None] * [1, 0, 1] + eye * [
            0,
            1,
            0,
        ]
    target = np.broadcast_to([0, 0.93, 0], still.shape) + (0.012 * shake[:, 3:6] if motion != "static" else 0)
    if motion == "rotating":
        target = target + np.stack([0.9 * u, 0.2 * np.sin(6 * u), 0 * u], 1)
    roll = 0.008 * shake[:, 6] if motion != "static" else np.zeros(frames)
    up = UP + np.stack([np.sin(roll) * np.cos(angle), 0 * roll, -np.sin(roll) * np.sin(angle)], 1)
    return np.stack([look_at(*view) for view in zip(eye, target, up)])


@dataclass
class Renderer(plain.Renderer):
    """Draws room and person with effects and garments."""

    effects: ClipEffects = NO_EFFECTS
    supersample: int = SUPERSAMPLE
    garments: Sequence[Garment] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        self.skin_faces = self.faces
        first = len(self.model.v_template) + np.cumsum([0, *(len(g.cloth.places) for g in self.garments)])
        self.faces = np.concatenate([self.skin_faces, *(g.faces + n for g, n in zip(self.garments, first))])

    def views(
        self,
        viewmats: np.ndarray,
        orient: np.ndarray,
        pose: np.ndarray,
        width: int,
        height: int,
        done: Callable[[int], None],
        passers: Sequence[Passer] = (),
        gain: np.ndarray | None = None,
        transl: np.ndarray | None = None,
        fps: float | None = None,
    ) -> TrueViews:
        """Draw the person in each pose from its camera, with `passers` behind and colours times `gain` [V,3].

        The person stands over the origin, or where `transl` [V,3] m says. Garments swing through the poses at `fps`, or
        have come to rest in each.
        """
        transl, vertices, joints = person.pose_body(self.body, self.betas, orient, pose, transl)
        if self.effects.clothing:
            vertices = vertices + swing(self.model, self.skin_faces, vertices, pose, self.effects.clothing)
        course, drawn = Course(viewmats, np.concatenate([vertices, self.worn((orient, pose, transl), fps)], 1)), []
        for i in range(len(viewmats)):
            drawn.append(self.shoot(course, i, width, height, passers, 1.0 if gain is None else gain[i]))
            done(i + 1)
        images, masks, depths = (np.stack(kind) for kind in zip(*drawn))
        Ks = np.broadcast_to(self.K, (len(viewmats), 3, 3)).copy()
        return TrueViews(images, masks, depths, viewmats, Ks, orient, pose, transl, joints)

    def worn(self, poses: Poses, fps: float | None) -> np.ndarray:
        """Where the particles of all garments [V,G,3] m are in each pose."""
        cloths, who = [garment.cloth for garment in self.garments], (self.body, self.skin_faces, self.betas)
        found = settled(cloths, *who, poses) if fps is None else worn(cloths, *who, poses, fps)
        return np.concatenate([np.zeros((len(poses[0]), 0, 3)), *found], 1)

    def shoot(
        self, course: Course, i: int, width: int, height: int, passers: Sequence[Passer], gain: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image uint8 [H,W,3], mask uint8 [H,W] and depth float32 [H,W] of frame `i`, as its camera takes it."""
        more = self.supersample
        fine, size = self.K * np.array([[more], [more], [1]]), (width * more, height * more)
        pad = margin(self.effects, fine, *size)
        moments = [self.draw(course, i + t, fine, *size, pad, passers) for t in open_times(self.effects)]
        colors, seen = moments[0][0], moments[0][1] * 1.0
        if len(moments) > 1:
            colors = to_srgb(np.mean([to_linear(colors) for colors, _ in moments], 0))
            seen = np.mean([seen for _, seen in moments], 0)
        image = distort((colors * gain).clip(0, 1) * 255, self.effects, fine, pad)
        mask = distort(seen[..., None] * 255.0, self.effects, fine, pad)
        pad = margin(self.effects, self.K, width, height)
        depth = distort(self.depth(course, i, width, height, pad)[..., None], self.effects, self.K, pad, order=0)
        return shrink(image, more), shrink(mask, more)[..., 0], depth[..., 0].astype(np.float32)

    def draw(
        self, course: Course, t: float, K: np.ndarray, width: int, height: int, pad: int, passers: Sequence[Passer]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours [H+2pad,W+2pad,3] 0..1 of moment `t`, and where the person is seen in them."""
        wide, width, height = K + np.array([[0, 0, pad], [0, 0, pad], [0, 0, 0]]), width + 2 * pad, height + 2 * pad
        vertices = course.body(t)
        room, room_depth = self.cast(course, t, wide, width, height, vertices)
        for passer in (passer for passer in passers if passer.inside(t)):
            depth, face, weights = self.fill(course, passer.at, passer.faces, t, wide, width, height)
            near = depth < room_depth
            room[near] = (passer.colors[passer.faces[face[near]]] * weights[near][..., None]).sum(1)
            room_depth = np.minimum(room_depth, depth)
        depth, face, weights = self.fill(course, course.body, self.faces, t, wide, width, height)
        seen = depth < room_depth
        corners, blend = self.faces[face[seen]], weights[seen][..., None]
        normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(self.faces)).numpy()
        normal = (normals[corners] * blend).sum(1)
        cloth = face[seen] >= len(self.skin_faces)
        sight = (vertices[corners[cloth]] * blend[cloth]).sum(1) - np.linalg.inv(course.viewmat(t))[:3, 3]
        normal[cloth] *= np.where((normal[cloth] * sight).sum(1) > 0, -1, 1)[:, None]  # cloth has two sides
        facing = normal @ LIGHT / np.linalg.norm(normal, axis=1)
        color = np.empty_like(normal)
        color[~cloth] = self.clothes((self.rest[corners[~cloth]] * blend[~cloth]).sum(1))
        first = len(self.skin_faces)
        for garment in self.garments:
            of = (face[seen] >= first) & (face[seen] < first + len(garment.faces))
            color[of] = garment.paint((garment.chart[face[seen][of] - first] * blend[of]).sum(1))
            first += len(garment.faces)
        if self.effects.shading:
            aside = normal @ SIDE_LIGHT / np.linalg.norm(normal, axis=1)
            color *= np.exp(0.5 * self.effects.shading * aside)[:, None]
        room[seen] = color * (0.66 + 0.34 * (0.5 + 0.5 * facing))[:, None]
        return room.clip(0, 1), seen

    def depth(self, course: Course, t: float, width: int, height: int, pad: int) -> np.ndarray:
        """z in m [H+2pad,W+2pad] of room and person at the pixel centres."""
        wide, width, height = (
            self.K + np.array([[0, 0, pad], [0, 0, pad], [0, 0, 0]]),
            width + 2 * pad,
            height + 2 * pad,
        )
        room = self.cast(course, t, wide, width, height)[1]
        return np.minimum(room, self.fill(course, course.body, self.faces, t, wide, width, height)[0])

    def fill(
        self, course: Course, things: Moving, faces: np.ndarray, t: float, K: np.ndarray, width: int, height: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, face and weights of the mesh `things`(moment) as seen at moment `t`."""
        return fill(camera_points(course, things, t, self.effects, K, height), faces, K, width, height)

    def cast(
        self, course: Course, t: float, K: np.ndarray, width: int, height: int, vertices: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colour and depth of the room at moment `t`, with the shadow of `vertices`, without the person."""
        room, effects = self.room, self.effects
        poses = np.stack([np.linalg.inv(course.viewmat(t + s)) for s in readout_times(effects, height)])
        colors, depth = cast(poses, K, width, height, room.boxes, room.paint, room.tints, room.mips, room.per_metre,
                              LIGHT, effects.view_dependence, LAMPS, effects.sky > 0)  # fmt: skip
        if vertices is None or not (effects.sky or effects.shadow):
            return colors, depth
        rays = _rays(K, width, height) @ poses[:, :3, :3].mT
        if effects.sky:
            far = np.isinf(depth)
            colors[far] = sky(rays[far])
        if effects.shadow:
            hit = np.isfinite(depth)
            points = (poses[:, None, :3, 3] + rays * depth[..., None])[hit]
            colors[hit] *= BodyShadow(vertices, self.faces, LIGHT, effects.shadow)(points)[:, None]
        return colors, depth


def _rays(K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Directions [H,W,3] of the pixel centres in camera coordinates, z = 1."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)

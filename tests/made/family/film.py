"""A shot of the family made: the person, their motion, the camera's path, the pictures and what is true of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import camera_centers, look_at, pinhole
from stages.avatar.motion.formulas import MOTIONS as FORMULAS
from stages.avatar.motion.placing import Soles
from stages.filming.motions import Manner, from_file
from stages.formats.body_model import read_body_model
from stages.records import BodyModel, BodyPoses, Cameras
from stages.synthetic import room as rooms
from stages.synthetic.person import SHIRT, TROUSERS, Outfit
from tests.made.family.legs import perform
from tests.made.family.motions import MOTIONS, Plan
from tests.made.family.shoes import shoes
from tests.made.family.table import LONG, SHORT, Box, Shot
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import ClipEffects
from tests.made.synthetic.wardrobe import make_garments
from tests.made.truth import Similarity

PER_BETA = 0.1
"""m that the free body grows with its first shape."""
LARGEST_BETA = 2.4
HEAD = 1.18
"""How much larger a child's head is against the rest of the body."""
HALL = ((0.0, 1.7, 3.2), (5.5, 1.7, 6.6))
"""Middle and half sizes of the room: high and deep enough for any camera of the table."""
SHAKE, TREMOR = 0.012, 0.006
"""What a hand adds to the camera's place, m, and to its direction, rad."""
CAPTURE_FPS = 60.0
"""Of AIST++, whose file does not say it."""
POINTS, POINT_NOISE, SPOT_NOISE = 1500, 0.003, 0.3
"""Of the cloud: how many, m in any direction, and px that its depth is wrong by."""
CENTER_NOISE, TURN_NOISE = 0.001, 3e-4
"""What SfM's cameras are wrong by: m, rad."""


@dataclass(frozen=True)
class Film:
    """Pictures [F,H,W,3] and true masks [F,H,W] uint8, the true person and cameras (m, y up, floor at y = 0).

    What SfM would find, in its own world and unit: `placed` cameras, `points` [P,3] with `colors` [P,3] uint8, and
    whether the camera is `moving`. `to_truth` leads from that world to the true one.
    """

    images: np.ndarray
    masks: np.ndarray
    model: BodyModel
    poses: BodyPoses
    cameras: Cameras
    placed: Cameras
    points: np.ndarray
    colors: np.ndarray
    moving: bool
    to_truth: Similarity


class OneColour(Outfit):
    """The outfit with shirt and trousers of one colour each."""

    def _shirt(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.broadcast_to(SHIRT, (len(x), 3)).copy()

    def _legs(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.broadcast_to(TROUSERS, (len(x), 3)).copy()


def film(shot: Shot, captures: Path | None) -> Film:
    """Make the shot; `captures` is the folder of captured motions."""
    rng = np.random.default_rng(list(shot.name.encode()))
    model, betas = person(shot, rng)
    body = Body(model, dtype=torch.float64)
    orient, pose, transl = moved(shot, body, model, betas, captures)
    worn = make_garments(shot.wears, model, betas, np.random.default_rng([*shot.name.encode(), 1]))
    worn += [shoes(model, betas, shot.sole)] if shot.sole else []
    width, height = (LONG, SHORT) if shot.wide else (SHORT, LONG)
    K = pinhole(shot.lens / 36 * LONG, width, height)
    viewmats = path(shot, transl, rng)
    room, swings = hall(rng, shot.boxes, np.radians(shot.facing)), ClipEffects(clothing=shot.clothing)
    renderer = synthetic.Renderer(model, room, betas, K, swings, 1, worn)
    if shot.plain:
        renderer.clothes = OneColour(model)
    views = renderer.views(viewmats, orient, pose, width, height, lambda done: None, transl=transl, fps=shot.fps)
    names = tuple(f"{i:06d}" for i in range(shot.frames))
    cameras = Cameras(names, viewmats, views.Ks, width, height)
    poses = BodyPoses(names, betas, orient, pose, transl, np.ones(shot.frames))
    points, colors = cloud(renderer, views, rng)
    placed, points, to_truth = as_sfm_has_it(shot, cameras, points, rng)
    colors, moving = colors[: len(points)], shot.path != "still"
    return Film(views.images, views.masks, model, poses, cameras, placed, points, colors, moving, to_truth)


def person(shot: Shot, rng: np.random.Generator) -> tuple[BodyModel, np.ndarray]:
    """The body model and betas [10] of somebody that tall and heavy; the rest of the shape by chance."""
    model, betas = read_body_model(), rng.uniform(-0.6, 0.6, 10)
    betas[[0, 4]] = 0.0, shot.heavy
    if shot.child:
        model = with_large_head(model)
    else:
        betas[0] = np.clip((shot.stature - 1.708) / PER_BETA, -LARGEST_BETA, LARGEST_BETA)
    tall = np.ptp((model.v_template + model.shapedirs @ betas)[:, 1])
    size = np.float32(shot.stature / tall)
    return replace(model, v_template=model.v_template * size, shapedirs=model.shapedirs * size), betas


def with_large_head(model: BodyModel) -> BodyModel:
    """The model with the head made larger about its joint."""
    joint = model.J_regressor[15] @ model.v_template
    share = model.lbs_weights[:, [15]] * np.float32(HEAD - 1)
    return replace(model, v_template=model.v_template + share * (model.v_template - joint))


def moved(
    shot: Shot, body: Body, model: BodyModel, betas: np.ndarray, captures: Path | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """global_orient [F,3], body_pose [F,69] and transl [F,3] of the shot's motion, float64."""
    t = np.arange(shot.frames) / shot.fps
    if shot.motion in MOTIONS:
        motion = perform(on_slope(MOTIONS[shot.motion](t), np.radians(shot.slope)), body, betas)
    elif shot.motion in FORMULAS:
        leg = -float(body.rest(torch.from_numpy(betas))[0][:, 1].min()) - 0.11
        motion = tuple(
            part.numpy().astype(np.float64) for part in FORMULAS[shot.motion](shot.frames / shot.fps, shot.fps, leg)
        )
        motion = on_floor(*motion, body, betas)
    elif captures is None:
        raise ValueError(f"{shot.name} needs the folder of captured motions")
    else:
        rate = CAPTURE_FPS if shot.motion.endswith(".npz") else None
        soles = Soles.of_model(model, betas)
        placed, _ = from_file(captures / shot.motion, Manner(shot.fps, motion_fps=rate), soles, model.parents.tolist())
        first = round(shot.start * shot.fps)
        motion = tuple(
            values[first : first + shot.frames] for values in (placed.global_orient, placed.body_pose, placed.transl)
        )
        motion[2][:, [0, 2]] -= motion[2][:, [0, 2]].mean(0)
        motion = on_floor(*motion, body, betas)
    orient, pose, transl = motion
    turn = Rotation.from_rotvec([0, np.radians(shot.facing), 0])
    ridden = shot.ride * (t - t.mean())
    place = turn.apply(transl) + ridden[:, None] * [1, 0, 0] + [0, shot.sole, 0]
    return (turn * Rotation.from_rotvec(orient)).as_rotvec(), pose, place


def on_slope(plan: Plan, slope: float) -> Plan:
    """The plan, of somebody who looks along +z, on a floor that rises ahead by `slope` rad: seen from the floor, they lean."""
    plan.spot[:, 1] += plan.tall * np.sin(slope)
    plan.tall *= np.cos(slope)
    plan.lean += slope
    return plan


def upright(shot: Shot) -> np.ndarray:
    """The turn [3,3] from the floor's normal, y, to what is up on its slope."""
    facing = np.radians(shot.facing)
    return Rotation.from_rotvec(np.radians(shot.slope) * np.array([np.cos(facing), 0, -np.sin(facing)])).as_matrix()


def on_floor(
    orient: np.ndarray, pose: np.ndarray, transl: np.ndarray, body: Body, betas: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The motion with its lowest moment on y = 0: what its own heights say above that stays."""
    with torch.no_grad():
        low = body(*(torch.from_numpy(part) for part in (betas, orient, pose, transl)))[0][..., 1].min().item()
    return orient, pose, transl - [0, low, 0]


def path(shot: Shot, transl: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """viewmats [F,4,4] of the shot's camera, which is held upright as the person is."""
    u = np.linspace(-0.5, 0.5, shot.frames)
    shake = synthetic.tremor(shot.frames, shot.fps, rng)
    held = 0.0 if shot.path == "still" else 0.15 if shot.path == "little" else 1.0
    angle = np.radians(shot.reach) * u if shot.path == "arc" else 0 * u
    away = shot.distance - (shot.reach * (u + 0.5) if shot.path == "forward" else 0)
    eye = np.stack([away * np.sin(angle), 0 * u + shot.height, away * np.cos(angle)], 1)
    eye[:, 0] += shot.reach * u if shot.path == "sideways" else 0
    eye = eye + SHAKE * held * (3 if shot.path == "jitter" else 1) * shake[:, :3]
    way = transl * [1, 0, 1] * (shot.path != "still")
    smooth = np.stack([np.polyval(np.polyfit(u, axis, 3), u) for axis in way.T], 1)
    eye, target = eye + shot.follow * smooth, smooth + [0, shot.aim, 0]
    turned = target + TREMOR * shot.distance * min(1.0, held * 2) * shake[:, 3:6]
    views = []
    for i in range(shot.frames):
        view = look_at(eye[i], turned[i], synthetic.UP)
        roll = np.radians(shot.roll) + 0.5 * TREMOR * held * shake[i, 6]
        spun = np.eye(4)
        spun[:3, :3] = Rotation.from_rotvec([0, 0, roll]).as_matrix()
        views.append(spun @ view)
    viewmats = np.stack(views)
    viewmats[:, :3, :3] = viewmats[:, :3, :3] @ upright(shot).T
    return viewmats


def hall(rng: np.random.Generator, boxes: tuple[Box, ...], turn: float) -> rooms.Room:
    """A large room with the furniture of the demo clip along its walls, its floor at y = 0, and `boxes`, turned by `turn` rad."""
    room = rooms.make_room(rng)
    placed = room.boxes.copy()
    placed[0, :6] = np.concatenate(HALL)
    placed[2:, 0] *= 1.5
    placed[2:, 2] -= 1.1
    placed[1, 1] = -0.003  # the rug: its top is 1 mm over the floor
    about = Rotation.from_rotvec([0, turn, 0])
    more = [[*about.apply(center), *half, np.cos(turn), np.sin(turn)] for center, half in boxes]
    count = len(boxes)
    paint = np.concatenate([room.paint, np.full((count, 6), rooms.WOOD)])
    tints = np.concatenate([room.tints, np.tile([[0.8, 0.65, 0.5]], (count, 1))])
    return replace(room, boxes=np.concatenate([placed, np.array(more).reshape(-1, 8)]), paint=paint, tints=tints)


def cloud(
    renderer: synthetic.Renderer, views: synthetic.TrueViews, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] m of the room that the pictures show beside the person, wrong as SfM is, and their colours [P,3]."""
    centers = camera_centers(views.viewmats)
    wide = np.linalg.norm(centers - centers.mean(0), axis=1).max() * 2
    points, colors = [], []
    count, _, width = views.masks.shape
    for i in range(count):
        free = np.flatnonzero(views.masks[i].ravel() == 0)
        row, column = np.divmod(rng.choice(free, POINTS // count + 1), width)
        z = views.depths[i][row, column].astype(np.float64)
        z = z + z**2 / renderer.K[0, 0] * (SPOT_NOISE / max(wide, 0.05)) * rng.standard_normal(len(z)).clip(-2, 2)
        pixel = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], 1)
        ray = pixel @ np.linalg.inv(renderer.K).T
        view = views.viewmats[i]
        points.append((ray * z[:, None] - view[:3, 3]) @ view[:3, :3] + POINT_NOISE * rng.standard_normal((len(z), 3)))
        colors.append(views.images[i][row, column])
    return np.concatenate(points), np.concatenate(colors)


def as_sfm_has_it(
    shot: Shot, cameras: Cameras, points: np.ndarray, rng: np.random.Generator
) -> tuple[Cameras, np.ndarray, Similarity]:
    """Cameras and points in a world with other axes, origin and unit, the cameras a little wrong; and the way back.

    A camera that stands still is at the origin, and there are no points.
    """
    if shot.path == "still":
        back = cameras.viewmats[0, :3, :3].T
        placed = replace(cameras, viewmats=np.tile(np.eye(4), (len(cameras), 1, 1)))
        return placed, np.zeros((0, 3)), Similarity(1.0, back, -back @ cameras.viewmats[0, :3, 3])
    turn, origin = Rotation.random(rng=rng).as_matrix(), rng.uniform(-2, 2, 3)
    unit = np.exp(rng.uniform(-1.2, 1.2))  # m
    noise = Rotation.from_rotvec(TURN_NOISE * rng.standard_normal((len(cameras), 3))).as_matrix()
    centers = (cameras.centers + CENTER_NOISE * rng.standard_normal((len(cameras), 3)) - origin) @ turn.T / unit
    viewmats = np.tile(np.eye(4), (len(cameras), 1, 1))
    viewmats[:, :3, :3] = noise @ cameras.viewmats[:, :3, :3] @ turn.T
    viewmats[:, :3, 3] = -(viewmats[:, :3, :3] @ centers[..., None])[..., 0]
    return replace(cameras, viewmats=viewmats), (points - origin) @ turn.T / unit, Similarity(unit, turn.T, origin)

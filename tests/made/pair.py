"""Two people in the room of the synthetic clip, who cross before the camera: the truth of each, of both and of the empty room."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stages.avatar.cameras.pinhole import pinhole
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.cameras import write_cameras
from stages.formats.ground import write_ground
from stages.formats.images import write_image, write_mask
from stages.formats.people import folder_of
from stages.formats.points import write_points
from stages.formats.poses import write_poses
from stages.records import BodyPoses, Cameras, Ground
from stages.synthetic import person
from stages.synthetic.clip import FOCAL, SUPERSAMPLE, TrueViews, camera_path
from stages.synthetic.room import make_room
from tests.made.datasets import points_of
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import NO_EFFECTS, Course

REACH = 0.75  # m to the side where a way begins and ends
DEPTHS = (0.35, -0.45)  # m: the first passes before the second
OTHER_INKS = (2, 0, 1)  # the second wears the first one's colours, their channels exchanged


@dataclass(frozen=True)
class Pair:
    """F frames of two people: `views` of each have the same images, and masks of what is seen of one.

    `alone` [2,F,H,W,3] shows one over white as if the other were not there, with `whole` [2,F,H,W] their masks then; `rooms`
    [F,H,W,3] nobody and no shadow. `betas` [2,10].
    """

    views: tuple[TrueViews, TrueViews]
    betas: np.ndarray
    alone: np.ndarray
    whole: np.ndarray
    rooms: np.ndarray


def make_pair(
    *, seed: int = 0, width: int = 320, height: int = 180, frames: int = 30, fps: float = 12.0, shadow: float = 0.0
) -> Pair:
    """The same arguments give the same bytes; `shadow` is the share of the light that both take from the room."""
    model, rng = read_body_model(), np.random.default_rng(seed)
    room, K = make_room(rng), pinhole(FOCAL * height, width, height)
    viewmats = camera_path(frames, fps, rng)
    betas, truth, courses, drawers = [], [], [], []
    for number, (depth, side) in enumerate(zip(DEPTHS, (1.0, -1.0), strict=True)):
        own = np.random.default_rng([seed, 11 + number])
        betas.append(own.uniform(-0.8, 0.8, 10))
        drawer = synthetic.Renderer(model, room, betas[-1], K, replace(NO_EFFECTS, shadow=shadow))
        if number:
            drawer.clothes = _Reinked(drawer.clothes)
        orient, pose = person.make_motion(frames, fps, own)
        along = side * REACH * np.linspace(-1, 1, frames)
        steps = np.stack([along, 0 * along, 0 * along + depth], 1)
        start = person.pose_body(drawer.body, betas[-1], orient, pose)[0]
        transl, vertices, joints = person.pose_body(drawer.body, betas[-1], orient, pose, start + steps)
        courses.append(Course(viewmats, vertices))
        drawers.append(drawer)
        truth.append((orient, pose, transl, joints))
    pictures = [_shoot(drawers, courses, i, width, height) for i in range(frames)]
    images, masks, depths, alone, whole, rooms = (np.stack(kind) for kind in zip(*pictures, strict=True))
    Ks = np.broadcast_to(K, (frames, 3, 3)).copy()
    one, other = (TrueViews(images, masks[:, k], depths, viewmats, Ks, *known) for k, known in enumerate(truth))
    return Pair((one, other), np.stack(betas), alone.swapaxes(0, 1), whole.swapaxes(0, 1), rooms)


class _Reinked:
    """Clothes in other colours; the head stays as it is."""

    def __init__(self, outfit: person.Outfit):
        self.outfit = outfit

    def __call__(self, points: np.ndarray) -> np.ndarray:
        colors, head = self.outfit(points), points[:, 1] > self.outfit.at["nose"][1] - 0.08
        return np.where(head[:, None], colors, colors[:, OTHER_INKS])


def _shoot(
    drawers: list[synthetic.Renderer], courses: list[Course], i: int, width: int, height: int
) -> tuple[np.ndarray, ...]:
    """Of a frame: image, masks [2,H,W], depth float32 [H,W], each alone [2,H,W,3], whole masks [2,H,W] and the room."""
    more, size = SUPERSAMPLE, (width * SUPERSAMPLE, height * SUPERSAMPLE)
    fine = drawers[0].K * np.array([[more], [more], [1]])
    each = [
        (*drawer.draw(course, i, fine, *size, 0, ()), drawer.fill(course, course.body, drawer.faces, i, fine, *size)[0])
        for drawer, course in zip(drawers, courses, strict=True)
    ]
    colors = np.minimum(each[0][0], each[1][0])  # of the room: in the shadow of either
    nearer = each[0][2] <= each[1][2]
    masks = [each[0][1] & nearer, each[1][1] & ~nearer]
    for (drawn, *_), mask in zip(each, masks, strict=True):
        colors[mask] = drawn[mask]
    white = [np.where(seen[..., None], drawn, 1.0) for drawn, seen, _ in each]
    depth = np.minimum(*(d.depth(c, i, width, height, 0) for d, c in zip(drawers, courses, strict=True)))
    room = drawers[0].cast(courses[0], i, fine, *size)[0]
    small = [[_shrunk(one[..., None] * 1.0)[..., 0] for one in kind] for kind in (masks, [each[0][1], each[1][1]])]
    shown = _shrunk(colors), np.stack(small[0]), depth.astype(np.float32)
    return *shown, np.stack([_shrunk(one) for one in white]), np.stack(small[1]), _shrunk(room)


def _shrunk(values: np.ndarray) -> np.ndarray:
    return synthetic.shrink(values.clip(0, 1) * 255, SUPERSAMPLE)


def write_stages(pair: Pair, folder: Path, points: int = 3000) -> dict[str, Path]:
    """What frames, masks, sfm, smpl and survey would leave of it, had they found the truth; stage -> folder."""
    folders = {name: folder / name for name in ("frames", "masks", "sfm", "smpl", "survey")}
    views, count = pair.views[0], len(pair.views[0])
    height, width = views.masks.shape[1:]
    names = tuple(f"{i:06d}" for i in range(count))
    everybody = np.maximum(*(one.masks for one in pair.views))
    for place in folders.values():
        place.mkdir(parents=True)
    for place in (folders["frames"], folders["sfm"]):
        (place / "images").mkdir()
        for name, image in zip(names, views.images, strict=True):
            write_image(place / "images" / f"{name}.png", image)
    sets = {".": everybody, "people/1": pair.views[0].masks, "people/2": pair.views[1].masks}
    for place in (folders["masks"], folders["sfm"]):
        for inside, masks in sets.items():
            (place / inside / "masks").mkdir(parents=True)
            for name, mask in zip(names, masks, strict=True):
                write_mask(place / inside / "masks" / f"{name}.png", mask)
    write_cameras(folders["sfm"] / "cameras.npz", Cameras(names, views.viewmats, views.Ks, width, height))
    at = np.array(points_of(replace(views, masks=everybody), points))
    z = views.depths[at[:, 0], at[:, 2], at[:, 1]]
    rays = np.stack([at[:, 1] + 0.5, at[:, 2] + 0.5, np.ones(len(at))], 1) @ np.linalg.inv(views.Ks[0]).T
    seen = views.viewmats[at[:, 0]]
    world = np.einsum("nji,nj->ni", seen[:, :3, :3], rays * z[:, None] - seen[:, :3, 3])
    write_points(folders["sfm"] / "points.ply", world, views.images[at[:, 0], at[:, 2], at[:, 1]])
    for k, one in enumerate(pair.views):
        place = folder_of(folders["smpl"], k + 1)
        place.mkdir(parents=True, exist_ok=True)
        known = one.global_orient, one.body_pose, one.transl, np.ones(count)
        write_poses(place / "body.npz", BodyPoses(names, pair.betas[k], *known))
        (place / "smpl.json").write_text("{}")
    write_body_model(folders["smpl"] / "body_model.npz", read_body_model())
    ground = Ground(np.zeros(3), np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), 1.0, 0.01, 0.01, 40, "made")
    write_ground(folders["smpl"] / "ground.json", ground)
    listed = [{"name": name, "index": i, "time_s": i / 12} for i, name in enumerate(names)]
    video = {"path": "pair.mp4", "width": width, "height": height, "fps": 12, "frames": count}
    facts = {
        "frames/frames.json": {"video": video, "width": width, "height": height, "frames": listed},
        "masks/masks.json": {"source": "imported"},
        "sfm/sfm.json": {"verdict": "moving", "distortion": {"max_shift_px": 0.0}},
        "survey/survey.json": {
            "measures": {},
            "effects": {},
            "decisions": {"scene": True, "pose_refinement": False},
            "starts": {},
        },
    }
    for path, value in facts.items():
        (folder / path).write_text(json.dumps(value))
    return folders

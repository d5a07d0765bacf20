"""Clips of somebody who keeps one pose, and ten poses that the clip never shows, with all truth.

The kind of clip that most people film: arms a little off the body, one turn. Clothes that lie near the body are its own
vertices, moved out; a coat and a skirt swing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import vertex_normals
from stages.avatar.cameras.pinhole import pinhole
from stages.formats.body_model import read_body_model
from stages.synthetic.room import make_room
from tests.made.synthetic import clip as synthetic
from tests.made.synthetic.effects import Course
from tests.made.synthetic.passers import Passer
from tests.made.synthetic.wardrobe import make_garments

FPS = 12.0
HEAVY = 4  # the shape's number that makes the free body wide at the same height
L_HIP, R_HIP, SPINE1, L_KNEE, R_KNEE, SPINE2, SPINE3 = 1, 2, 3, 4, 5, 6, 9
L_ARM, R_ARM, L_ELBOW, R_ELBOW = 16, 17, 18, 19
Turns = dict[int, tuple[float, float, float]]
"""Joint -> turns about x, y and z, rad."""


def both(left: int, right: int, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Turns:
    """The same turn on both sides, mirrored."""
    return {left: (x, y, z), right: (x, -y, -z)}


HANGING = both(L_ARM, R_ARM, z=-1.25)
A_POSE: Turns = both(L_ARM, R_ARM, z=-0.85) | both(L_HIP, R_HIP, z=0.1)
SITTING: Turns = both(L_ARM, R_ARM, 0.4, 0, -0.95) | both(L_HIP, R_HIP, -1.45, 0, 0.1) | both(L_KNEE, R_KNEE, 1.45)
NOVEL: dict[str, Turns] = {
    "legs wide apart": both(L_HIP, R_HIP, z=0.55) | both(L_ARM, R_ARM, z=-0.7),
    "arms overhead": both(L_ARM, R_ARM, z=1.25),
    "squat": both(L_HIP, R_HIP, -1.5, 0, 0.3) | both(L_KNEE, R_KNEE, 1.8) | both(L_ARM, R_ARM, 0, -1.3, 0),
    "bend": {SPINE1: (0.5, 0, 0), SPINE2: (0.4, 0, 0), SPINE3: (0.2, 0, 0)} | HANGING,
    "hands to hips": both(L_ARM, R_ARM, z=-0.75) | both(L_ELBOW, R_ELBOW, z=-1.35),
    "lunge": {L_HIP: (-1.2, 0, 0), L_KNEE: (1.2, 0, 0), R_HIP: (0.5, 0, 0), R_KNEE: (0.4, 0, 0)} | HANGING,
    "a leg lifted": {L_HIP: (0, 0, 0.9)} | both(L_ARM, R_ARM, z=-0.3),
    "side bend": {SPINE1: (0, 0, 0.3), SPINE2: (0, 0, 0.3), SPINE3: (0, 0, 0.2), L_ARM: (0, 0, -1.2), R_ARM: (0, 0, -1.2)},
    "stride": {L_HIP: (-0.8, 0, 0), L_KNEE: (1.1, 0, 0), R_HIP: (0.5, 0, 0), R_KNEE: (0.9, 0, 0)}
    | {L_ARM: (0.6, 0, -1.2), R_ARM: (-0.6, 0, 1.2)},
    "pointing": {R_ARM: (0, 1.3, 0), L_ARM: (0, 0, -1.2)},
}  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """How somebody stands or walks while filmed, what they wear, and how wide they are."""

    pose: Turns | None  # None: a walk that is seen from the front
    ease: Callable[[np.ndarray], np.ndarray]  # how far clothes stand off [V] m, by where a vertex is along the legs [V]
    wears: Sequence[str] = ()
    heavy: float = 0.0


def _cut(at: Sequence[float], off: Sequence[float]) -> Callable[[np.ndarray], np.ndarray]:
    """Clothes `off` m where the legs are `at`: 0 at the hips, 1 at the knees, 2 at the ankles."""
    return lambda along: np.interp(along, at, off)


JEANS = _cut((-0.3, -0.2, 0.5, 1.0, 1.9, 2.0), (0, 0.012, 0.018, 0.022, 0.026, 0))
SHORTS = _cut((-0.3, -0.2, 0.8, 0.85), (0, 0.012, 0.032, 0))
WIDE = _cut((-0.3, -0.2, 0.5, 1.0, 1.9, 2.0), (0, 0.012, 0.028, 0.04, 0.055, 0))
BARE = _cut((0.0, 1.0), (0, 0))
KINDS: dict[str, Kind] = {
    "jeans": Kind(A_POSE, JEANS, heavy=1.3),
    "jeans_hanging": Kind(HANGING, JEANS, heavy=-1.0),
    "shorts_walk": Kind(None, SHORTS),
    "wide": Kind(A_POSE, WIDE, heavy=-0.8),
    "sitting": Kind(SITTING, JEANS, heavy=0.5),
    "turned_coat": Kind(HANGING, BARE, ("coat",)),
    "turned_skirt": Kind(A_POSE, BARE, ("skirt",)),
    "turned_hair": Kind(A_POSE, JEANS, ("hair",)),
}


def pose_of(turns: Turns) -> np.ndarray:
    """body_pose [69] rad."""
    pose = np.zeros((24, 3))
    for joint, angles in turns.items():
        pose[joint] = Rotation.from_euler("XYZ", angles).as_rotvec()
    return pose[1:].ravel()


def motion(kind: Kind, frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """global_orient [F,3] and body_pose [F,69] of one turn with a little sway, or of a walk on the spot."""
    u, t = np.linspace(0, 1, frames), np.arange(frames) / FPS
    if kind.pose is None:
        pose = np.zeros((frames, 24, 3))
        for i, side in enumerate((1.0, -1.0)):
            step = side * np.sin(2 * np.pi * t / 1.1)
            pose[:, L_HIP + i, 0], pose[:, L_KNEE + i, 0] = -0.45 * step, 0.1 + 0.7 * np.maximum(step, 0)
            arm = Rotation.from_euler("ZX", np.stack([np.full(frames, -1.2 * side), 0.35 * step], 1))
            pose[:, L_ARM + i] = arm.as_rotvec()
        return np.stack([0 * u, 0.1 * np.sin(5 * u), 0 * u], 1), pose[:, 1:].reshape(frames, 69)
    sway = np.stack([np.sin(2 * np.pi * f * t + p) for f, p in zip((0.5, 0.8), rng.uniform(0, 6, 2))], 1)
    shift = rng.normal(0, 0.02, (2, 69))
    return np.stack([0 * u, 0.4 - 2 * np.pi * u, 0 * u], 1), pose_of(kind.pose) + sway @ shift


class _Padded(synthetic.Renderer):
    """Draws clothes that lie near the body as its vertices, `ease` [V] m further out."""

    ease: np.ndarray

    def shoot(
        self, course: Course, i: int, width: int, height: int, passers: Sequence[Passer], gain: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        vertices, count = course.vertices[i].copy(), len(self.rest)
        normals = vertex_normals(torch.from_numpy(vertices[:count]), torch.from_numpy(self.skin_faces)).numpy()
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
        vertices[:count] += self.ease[:, None] * normals
        return super().shoot(Course(course.viewmats[i : i + 1], vertices[None]), 0, width, height, passers, gain)


def make(name: str, seed: int, width: int, height: int, frames: int) -> synthetic.SyntheticClip:
    """The clip of a kind; its truth's masks and pictures have the clothes, its body has none."""
    kind, model = KINDS[name], read_body_model()
    rng = np.random.default_rng([seed, 7])
    room, betas = make_room(rng), rng.uniform(-0.6, 0.6, 10)
    betas[HEAVY] = kind.heavy
    garments = make_garments(kind.wears, model, betas, np.random.default_rng([seed, 2]))
    drawer = _Padded(model, room, betas, pinhole(synthetic.FOCAL * height, width, height), garments=garments)
    assert model.keypoint_regressor is not None and model.keypoint_names is not None
    places = dict(zip(model.keypoint_names, model.keypoint_regressor @ model.v_template))
    marks = [places[f"left_{joint}"][1] for joint in ("ankle", "knee", "hip")]
    x, y, _ = model.v_template.T
    along = np.interp(y, [marks[0], *marks[1:], 2 * marks[2] - marks[1]], [2, 1, 0, -1])
    drawer.ease = kind.ease(along) * (abs(x) < 0.4) * (y > marks[0] - 0.02)
    orient, pose = motion(kind, frames, rng)
    viewmats = synthetic.camera_path(frames, FPS, "moving", rng)
    clip = drawer.views(viewmats, orient, pose, width, height, lambda done: None, fps=FPS)
    turns = np.stack([[0, turn, 0] for turn in np.linspace(-0.9, 0.9, len(NOVEL))])
    poses = np.stack([pose_of(turned) for turned in NOVEL.values()])
    novel = drawer.views(synthetic.novel_cameras(len(NOVEL)), turns, poses, width, height, lambda done: None)
    return synthetic.SyntheticClip(clip, novel, betas, FPS)

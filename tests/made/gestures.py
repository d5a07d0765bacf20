"""Clips of somebody whose hands open, close and point and whose face talks, near and far, and six gestures that no frame shows,
with all truth.

Fingers and face move as the free body's do; cameras go around the person by 50 degrees, who stands and turns a little.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.face import face_at, face_vector
from stages.avatar.body.fingers import bent_skin, finger_bones, finger_joints
from stages.avatar.body.joints import HEAD, WRISTS
from stages.avatar.body.smpl import Body
from stages.avatar.cameras.pinhole import look_at, pinhole
from stages.avatar.drawing.attach import FACE
from stages.avatar.motion.gestures import MIRRORED, fingers_at, say_a_sentence
from stages.avatar.splats.neighbours import mean_near, nearest
from stages.formats.body_model import read_body_model
from stages.formats.hands_face import read_hands_face
from stages.records import BodyModel
from stages.synthetic.clip import FOCAL, UP, SyntheticClip, tremor
from stages.synthetic.room import make_room
from tests.made.synthetic import clip as synthetic

FPS = 12.0
KINDS = {"near": (1.25, 1.22), "far": (2.75, 0.93)}
"""How far the camera is, and how high it looks, m: hands are 60 and 25 px long in pictures 384 px high."""
ARC = 0.45  # rad to both sides
HELD = 0.5  # s from one pose of a hand to the next
SHOWN = {"open": (1, 1, 1, 1, 1), "closed": (0, 0, 0, 0, 0), "point": (1, 0, 0, 0, 0), "relaxed": (0.75,) * 5}
"""How far a hand's fingers are opened in the clip, in SMPL-X's order: index, middle, pinky, ring, thumb."""
BOTH = "Left", "Right"
NOVEL: dict[str, tuple[tuple[float, ...], dict[str, float]]] = {
    "two": ((1, 1, 0, 0, 0), {f"mouthFrown{side}": 1.0 for side in BOTH} | {f"browDown{side}": 0.8 for side in BOTH}),
    "horns": ((1, 0, 1, 0, 0), {"jawOpen": 0.9}),
    "thumb": ((0, 0, 0, 0, 1), {f"mouthSmile{side}": 1.0 for side in BOTH} | {"browInnerUp": 0.8}),
    "claw": ((0.4, 0.4, 0.4, 0.4, 0.9), {f"eyeBlink{side}": 1.0 for side in BOTH} | {"mouthPucker": 0.9}),
    "three": ((1, 1, 0, 0, 1), {"jawOpen": 0.6} | {f"mouthSmile{side}": 0.8 for side in BOTH}),
    "hook": ((0.5, 0.1, 0.6, 0.1, 0.2), {"mouthLeft": 1.0, "eyeBlinkRight": 1.0, "cheekSquintRight": 0.7}),
}
"""Fingers and expressions that the clip never shows."""
L_SHOULDER, L_ELBOW, L_WRIST = 16, 18, 20


@dataclass(frozen=True)
class Gestures:
    """Fingers `hands` [F,2,15,3] rad, as FINGER_NAMES, and coefficients `face` [F,52], as FACE_NAMES, of F pictures."""

    hands: np.ndarray
    face: np.ndarray

    def write(self, path: Path) -> None:
        """Write an .npz."""
        np.savez(path, hands=self.hands, face=self.face)

    @classmethod
    def read(cls, path: Path) -> Gestures:
        """Read an .npz of `write`."""
        with np.load(path) as arrays:
            return cls(arrays["hands"], arrays["face"])


def make(kind: str, seed: int, width: int, height: int, frames: int) -> tuple[SyntheticClip, Gestures, Gestures]:
    """The clip of one of KINDS, with what hands and face do in its frames and in its novel views."""
    model, rng = read_body_model(), np.random.default_rng([seed, 11])
    room, betas = make_room(np.random.default_rng(seed)), rng.uniform(-0.6, 0.6, 10)
    drawer = synthetic.Renderer(model, room, betas, pinhole(FOCAL * height, width, height))
    at = np.arange(frames) / FPS
    poses, cameras = arms(at, rng), views(kind, np.linspace(-ARC, ARC, frames), 0.01 * tremor(frames, FPS, rng)[:, :6])
    shown = Gestures(moving(at, rng), talking(at, rng))
    opened, faces = zip(*NOVEL.values())
    left = fingers_at(np.array(opened, float), np.full(len(NOVEL), 0.6))
    new = Gestures(np.stack([left, left * MIRRORED], 1), np.stack([face_vector(face) for face in faces]))
    beside = views(kind, np.linspace(-0.8 * ARC, 0.8 * ARC, len(NOVEL)), np.zeros((len(NOVEL), 6)))
    held = arms(rng.uniform(0, at[-1], len(NOVEL)), rng)
    found = []
    for gestures, viewmats, pose in ((shown, cameras, poses), (new, beside, held)):
        drawer.body = gesturing(model, betas, gestures)
        found.append(drawer.views(viewmats, *pose, width, height, lambda done: None, fps=FPS))
    return SyntheticClip(*found, betas, FPS), shown, new


def gesturing(model: BodyModel, betas: np.ndarray, gestures: Gestures) -> Body:
    """The body of a shape, for F poses at once, whose fingers and face at rest are moved as they are in each."""
    body, rig = Body(model, dtype=torch.float64), read_hands_face(model)
    assert rig is not None
    shape = torch.as_tensor(betas)
    rest, _ = body.rest(shape)
    points = face_at(rig, body.v_template, body.shapedirs, shape)
    shapes, away = torch.as_tensor(rig.face_shapes).to(rest).movedim(0, 1), nearest(points, rest, 1)[0][:, 0]
    part = ((FACE[1] - away) / (FACE[1] - FACE[0])).clamp(0, 1)
    head = (part > 0) & (body.lbs_weights[:, HEAD] > 0)
    own = part[head, None, None] * mean_near(shapes, points, rest[head], 3)
    moved = torch.stack([bent_skin(rig, rest, torch.as_tensor(turns)) - rest for turns in gestures.hands])
    moved[:, head] += torch.einsum("fk,vkc->fvc", torch.as_tensor(gestures.face), own)
    body.v_template = body.v_template + moved
    return body


def views(kind: str, angles: np.ndarray, shake: np.ndarray) -> np.ndarray:
    """viewmats [V,4,4] of a camera that looks at the person from `angles` [V] rad about them, off by `shake` [V,6] m."""
    away, height = KINDS[kind]
    eyes = np.stack([away * np.sin(angles), np.full(len(angles), height + 0.15), away * np.cos(angles)], 1)
    return np.stack(
        [look_at(eye, target, UP) for eye, target in zip(eyes + shake[:, :3], [0, height, 0] + shake[:, 3:])]
    )


def arms(at: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """global_orient [F,3] and body_pose [F,69] at moments [F] s of somebody who holds up both hands and turns them about."""
    a, b, c = (np.sin(2 * np.pi * f * at[:, None] + rng.uniform(0, 6, 2)) for f in (0.35, 0.5, 0.8))
    turns = np.zeros((len(at), 24, 3))
    for i, side in enumerate((1.0, -1.0)):
        raised, bent, twist = 0.15 * a[:, i], 2.1 + 0.2 * b[:, i], 0.5 + 0.5 * c[:, i]
        turns[:, L_SHOULDER + i] = _turned("yz", -0.1 * side + 0 * at, side * (-1.05 + raised))
        turns[:, L_ELBOW + i] = _turned("yx", -side * bent, -twist)
        turns[:, L_WRIST + i] = _turned("xz", -0.3 * twist, 0.2 * side * b[:, i])
    turns[:, HEAD] = _turned("yx", 0.15 * np.sin(2 * at + rng.uniform(0, 6)), 0.05 * np.sin(3 * at))
    orient = _turned("y", 0.3 * np.sin(1.3 * at + rng.uniform(0, 6)))
    return orient, turns[:, 1:].reshape(len(at), 69)


def moving(at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Hands [F,2,15,3] rad that go from one of SHOWN to the next, each for itself."""
    marks = HELD * np.arange(int(at[-1] / HELD) + 2)
    hands = np.zeros((len(at), 2, 15, 3))
    for i in (0, 1):
        order = np.concatenate([rng.permutation(len(SHOWN)) for _ in range(len(marks))])[: len(marks)]
        held = np.array(list(SHOWN.values()), float)[order]
        opened = np.stack([np.interp(at, marks, finger) for finger in held.T], 1)
        hands[:, i] = fingers_at(opened, opened.mean(1)) * (MIRRORED if i else 1)
    return hands


def talking(at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A face [F,52] in the middle of a sentence."""
    begin, loud = rng.uniform(0.5, 1.5), rng.uniform(1.0, 1.4)
    said = say_a_sentence(at[-1] + 4, 100.0)[1]
    return (loud * said[np.rint(100 * (at + begin)).astype(int)]).clip(0, 1)


def finger_points(model: BodyModel, betas: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """Joints and tips [...,2,20,3] m of the fingers in a pose [...,2,15,3] rad, from the wrist of the hand at rest."""
    rig = read_hands_face(model)
    assert rig is not None
    rest, joints = Body(model).rest(torch.as_tensor(betas).float())
    fingers, tips = finger_joints(rig, rest)
    bones = finger_bones(fingers, torch.as_tensor(hands).float(), torch.eye(4).expand(24, 4, 4))
    ends = bones[..., 2::3, :3, :3] @ tips[..., None] + bones[..., 2::3, :3, 3:]
    moved = bones[..., :3, :3] @ fingers[..., None] + bones[..., :3, 3:]
    parts = [part[..., 0].unflatten(-2, (2, -1)) for part in (moved, ends)]
    return (torch.cat(parts, -2) - joints[list(WRISTS), None]).numpy()


def _turned(axes: str, *angles: np.ndarray) -> np.ndarray:
    """Rotation vectors [F,3] of turns about body axes, the first written outermost."""
    return Rotation.from_euler(axes.upper(), np.stack(angles, 1)).as_rotvec()

"""The person of the synthetic clip: what they wear, how they move, and the poses the clip never shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from stages.avatar.body.smpl import Body
from stages.avatar.motion.formulas import MOTIONS
from stages.records import BodyModel

TURN = 4.6
"""How far the person turns during the clip, rad."""
NOVEL = (("jumping_jacks", 0.5, -0.5), ("wave", 0.4, 0.2), ("squats", 0.5, 0.7), ("walk_in_place", 0.25, 2.4),
         ("squats", 0.3, -2.0), ("jumping_jacks", 0.35, 3.1))  # fmt: skip
"""Motion, moment in its only cycle, and turn about y (rad) of each novel pose."""
SHIRT, BAND, RED = (0.17, 0.33, 0.58), (0.86, 0.88, 0.9), (0.72, 0.16, 0.18)
TROUSERS, STRIPE, BELT = (0.27, 0.29, 0.22), (0.62, 0.58, 0.42), (0.13, 0.09, 0.07)
SKIN, LIPS, HAIR, DARK, WHITE = (
    (0.84, 0.64, 0.53),
    (0.68, 0.33, 0.32),
    (0.17, 0.11, 0.08),
    (0.08, 0.07, 0.07),
    (0.93,) * 3,
)
SHOE = (0.75, 0.3, 0.12)


class Outfit:
    """Colours of the free body's skin, hair and clothes as a function of where a point is in the rest pose (betas 0)."""

    def __init__(self, model: BodyModel):
        """`model` has keypoints."""
        self.at = {name: place.astype(np.float64) for name, place in keypoints(model).items()}

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """RGB [N,3] 0..1 of rest-pose `points` [N,3] in metres, y up, facing +z."""
        x, y, z = points.T
        at, side = self.at, abs(points[:, 0])
        waist, ankle = at["left_hip"][1] + 0.05, at["left_ankle"][1]
        color = self._head(points)
        neck = np.minimum(y - at["left_shoulder"][1], 0.08 - side)
        sleeve = at["left_elbow"][0] - 0.04
        shirt = np.minimum.reduce([y - waist, sleeve - side, -neck, at["nose"][1] - 0.08 - y])
        color = _paint_over(color, self._shirt(x, y, z), shirt, 0.006)
        color = _paint_over(color, self._legs(x, y, z), np.minimum(waist - y, 0.4 - side), 0.006)
        color = _paint_over(color, BELT, 0.018 - abs(y - waist), 0.004, where=side < 0.4)
        watch = 0.014 - abs(x - at["left_wrist"][0] + 0.03)
        color = _paint_over(color, DARK, watch, 0.004)
        color = _paint_over(color, WHITE, np.minimum(ankle + 0.03 - y, 0.4 - side), 0.005)
        color = _paint_over(color, SHOE, np.minimum(ankle - 0.015 - y, 0.4 - side), 0.005)
        return _paint_over(color, WHITE, np.minimum(at["left_big_toe"][1] - 0.008 - y, 0.4 - side), 0.005)

    def _shirt(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        color = np.broadcast_to(SHIRT, (len(x), 3)).copy()
        for t in (x, y, z):
            color = _paint_over(color, BAND, _wave(t, 0.11) - 0.45, 0.25, strength=0.5)
            color = _paint_over(color, RED, _wave(t + 0.055, 0.11) - 0.9, 0.1, strength=0.6)
        emblem = 0.055 - np.hypot(x, y - 0.27)
        color = _paint_over(color, (0.95, 0.8, 0.2), emblem, 0.005, where=z > 0.03)
        bars = np.minimum(0.012 - abs(abs(x) - 0.03), 0.08 - abs(y - 0.3))
        return _paint_over(color, (0.95, 0.9, 0.8), bars, 0.005, where=z < 0.0)

    def _legs(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        hip, knee, ankle = (self.at[f"left_{name}"] for name in ("hip", "knee", "ankle"))
        axis = np.stack([np.interp(y, [ankle[1], knee[1], hip[1]], [ankle[k], knee[k], hip[k]]) for k in (0, 2)])
        around = np.arctan2(z - axis[1], abs(x) - axis[0])
        color = _paint_over(np.broadcast_to(TROUSERS, (len(x), 3)).copy(), STRIPE, np.sin(8 * around) - 0.3, 0.4)
        patch = 0.05 - abs(y - knee[1] - 0.03)
        return _paint_over(color, (0.55, 0.2, 0.16), patch, 0.006, where=x > 0)

    def _head(self, points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        at, side = self.at, abs(points[:, 0])
        eye, nose = at["left_eye"], at["nose"]
        color = np.broadcast_to(SKIN, (len(x), 3)).copy()
        front = z > eye[2] - 0.035
        blush = 0.02 - np.hypot(side - 0.045, y - nose[1] + 0.005)
        color = _paint_over(color, (0.86, 0.55, 0.47), blush, 0.03, where=front, strength=0.5)
        brow = 0.0045 - abs(y - eye[1] - 0.021 + 6 * (side - eye[0]) ** 2)
        color = _paint_over(color, HAIR, np.minimum(brow, 0.018 - abs(side - eye[0])), 0.003, where=front)
        white = 1 - np.hypot((side - eye[0]) / 0.0145, (y - eye[1]) / 0.0065)
        color = _paint_over(color, WHITE, white, 0.3, where=front)
        iris = np.minimum(0.006 - np.hypot(side - eye[0], y - eye[1]), white * 0.0065)
        color = _paint_over(color, (0.2, 0.14, 0.1), iris, 0.002, where=front)
        lips = 1 - np.hypot(x / 0.025, (y - nose[1] + 0.037) / 0.0085)
        color = _paint_over(color, LIPS, lips, 0.3, where=front)
        mouth = np.minimum(0.0013 - abs(y - nose[1] + 0.037), 0.022 - side)
        color = _paint_over(color, (0.35, 0.12, 0.12), mouth, 0.002, where=front)
        hairline = y - (eye[1] + 0.052 - 0.85 * (eye[2] - z)) - 0.004 * np.sin(x * 300)
        streaks = np.array(HAIR) * (1 + 0.35 * np.sin(140 * x + 60 * z + 8 * np.sin(50 * y)))[:, None]
        return _paint_over(color, streaks, np.minimum(hairline, y - nose[1] + 0.05), 0.006)


def make_motion(frames: int, fps: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """global_orient [F,3] and body_pose [F,69] of a person who turns on the spot, steps, swings and raises the arms."""
    u = np.linspace(0, 1, frames)
    step = 2 * np.pi * np.arange(frames) / fps / 1.1 + rng.uniform(0, 2 * np.pi)
    lift = rng.uniform(-0.06, 0.06, 2)
    turns = np.zeros((frames, 24, 3))
    for i, side in enumerate((1.0, -1.0)):
        foot = np.maximum(side * np.sin(step), 0)
        raised = np.sin(np.pi * (2 * u + 0.4 * i + lift[i])) ** 2
        swing = 0.35 * np.sin(step) * side * (1 - 0.6 * raised)
        turns[:, 1 + i] = _euler("xz", -0.5 * foot, np.full(frames, 0.05 * side))
        turns[:, 4 + i] = _euler("x", 0.05 + 0.85 * foot)
        turns[:, 7 + i] = _euler("x", -0.05 - 0.1 * foot)
        turns[:, 16 + i] = _euler("zx", side * (-1.15 + 1.45 * raised), swing)
        turns[:, 18 + i] = _euler("y", -side * (0.3 + 0.55 * np.sin(np.pi * (3 * u + 0.5 * i)) ** 2))
        turns[:, 13 + i] = _euler("z", side * 0.12 * raised)
    sway = 0.06 * np.sin(step + 0.5)
    turns[:, 3] = _euler("yz", sway, 0.3 * sway)
    turns[:, 6] = _euler("y", sway)
    turns[:, 15] = _euler("yx", 0.25 * np.sin(2 * np.pi * u), 0.08 * np.sin(3 * np.pi * u))
    eased = 0.6 * u + 0.4 * u * u * (3 - 2 * u)
    orient = _euler("yx", 0.6 - TURN * eased, np.full(frames, 0.03))
    return orient, turns[:, 1:].reshape(frames, 69)


def novel_poses() -> tuple[np.ndarray, np.ndarray]:
    """global_orient [P,3] and body_pose [P,69] of the poses in NOVEL, which `make_motion` never comes near."""
    orients, poses = [], []
    for name, moment, turn in NOVEL:
        orient, pose, _ = MOTIONS[name](2.0, 50.0)
        at = round(moment * len(pose))
        if name == "jumping_jacks":
            at //= 2  # two jumps in two seconds
        orients.append((Rotation.from_rotvec([0, turn, 0]) * Rotation.from_rotvec(orient[at].numpy())).as_rotvec())
        poses.append(pose[at].numpy().astype(np.float64))
    return np.stack(orients), np.stack(poses)


def pose_body(
    body: Body, betas: np.ndarray, orient: np.ndarray, pose: np.ndarray, transl: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """transl [F,3], vertices [F,V,3] and joints [F,24,3] m of a body.

    Without a `transl` the pelvis is over the origin and the lowest vertex on y = 0.
    """
    zeros = np.zeros_like(orient)
    with torch.no_grad():
        vertices, joints = body(*(torch.from_numpy(a) for a in (betas, orient, pose, zeros)))
    vertices, joints = vertices.numpy(), joints.numpy()
    if transl is None:
        transl = -joints[:, 0]
        transl[:, 1] = -vertices[..., 1].min(1)
    return transl, vertices + transl[:, None], joints + transl[:, None]


def keypoints(model: BodyModel) -> dict[str, np.ndarray]:
    """Rest positions [3] m of the keypoints by name. Raises ValueError for a model without keypoints."""
    if model.keypoint_regressor is None or model.keypoint_names is None:
        raise ValueError(f"the body model {model.name!r} has no keypoints, which the clothes are placed by")
    return dict(zip(model.keypoint_names, model.keypoint_regressor @ model.v_template))


def _euler(axes: str, *angles: np.ndarray) -> np.ndarray:
    """Rotation vectors [F,3] of turns about body axes, the first written outermost."""
    return Rotation.from_euler(axes.upper(), np.stack(angles, 1)).as_rotvec()


def _wave(t: np.ndarray, period: float) -> np.ndarray:
    return np.sin(2 * np.pi / period * t)


def _paint_over(
    below: np.ndarray,
    color: Sequence[float] | np.ndarray,
    inside: np.ndarray,
    edge: float,
    where: np.ndarray | bool = True,
    strength: float = 1.0,
) -> np.ndarray:
    """Paint `color` where `inside` > 0, with an edge of that width, over the colours below."""
    cover = ((inside / edge + 0.5).clip(0, 1) * where * strength)[:, None]
    return below * (1 - cover) + np.asarray(color) * cover

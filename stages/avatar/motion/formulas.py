"""Movements made by formula, for a person whose clip holds none of them; no motion capture needed.

Each function takes seconds and frames per second and returns (global_orient [F,3], body_pose [F,69], transl [F,3]):
rotation vectors in radians and metres, y up, facing +z, whole cycles starting and ending at rest. The pelvis starts at
transl 0. `leg` is the height of the hip over the ankle in metres; with it feet stay on the floor where they stand.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from stages.avatar.body.joints import ANKLES, COLLARS, ELBOWS, HEAD, HIPS, KNEES, SHOULDERS, SPINE, WRISTS
from stages.avatar.body.rotations import matrix_from_rotvec, rotvec_from_matrix

Motion = tuple[Tensor, Tensor, Tensor]

HANG = 1.22
"""How far the arms of the T-pose are lowered beside the body, rad."""
LEG = 0.82
"""Height of the hip over the ankle of an average adult, m."""
SIDES = ((0, 1.0), (1, -1.0))
"""Left and right: which of a pair of joints, and the sign of what is mirrored."""


def jumping_jacks(seconds: float, fps: float, leg: float = LEG) -> Motion:
    """Arms up as the feet jump apart, down as they jump together; landing with soft knees, still at each landing."""
    phase = _phase(seconds, fps, 1.1)
    opened = (1 - phase.cos()) / 2
    soft = 0.32 * phase.cos().square()
    pose = _Pose(len(phase))
    for i, side in SIDES:
        pose.turn(COLLARS[i], z=side * 0.25 * opened)
        pose.turn(SHOULDERS[i], z=side * (-HANG + (HANG + 0.95) * opened), y=-side * 0.25 * phase.sin().square())
        pose.turn(ELBOWS[i], y=-side * (0.2 + 0.25 * phase.sin().square()))
        pose.turn(HIPS[i], x=-soft, z=side * 0.4 * opened)
        pose.turn(KNEES[i], x=1.9 * soft)
        pose.turn(ANKLES[i], x=-0.9 * soft, z=-side * 0.34 * opened)
    pose.turn(SPINE[0], x=0.35 * soft)
    hop = 0.09 * phase.sin().square()
    return pose.motion(lift=hop, leg=leg)


def walk_in_place(seconds: float, fps: float, leg: float = LEG) -> Motion:
    """Marching on the spot: knees up in turn, arms swinging against them, weight over the foot that stands."""
    phase = _phase(seconds, fps, 1.1)
    start = ease(seconds, fps, 0.4)
    sway = -0.025 * phase.sin() * start  # over the right foot (x < 0) while the left one is up
    pose = _Pose(len(phase))
    for i, side in SIDES:
        wave = side * phase.sin()
        raised = wave.clamp(min=0).square() * start
        swing = wave * start
        pose.turn(HIPS[i], x=-0.85 * raised, z=-sway / leg)
        pose.turn(KNEES[i], x=0.04 + 1.5 * raised)
        pose.turn(ANKLES[i], x=-0.04 + 0.1 * raised, z=sway / leg)
        pose.turn(SHOULDERS[i], x=0.6 * swing - 0.05, z=torch.full_like(swing, -side * HANG), order="xz")
        pose.turn(ELBOWS[i], y=-side * (0.45 - 0.3 * swing))
    twist = 0.07 * phase.sin() * start
    pose.turn(SPINE[1], y=-twist, z=-0.5 * sway)
    pose.turn(SPINE[2], y=-twist)
    pose.turn(HEAD, y=2 * twist)
    return pose.motion(shift=sway, leg=leg)


def wave(seconds: float, fps: float, leg: float = LEG) -> Motion:
    """Standing, the right hand raised and waving, the weight a little on one leg; the arm goes up and comes down."""
    phase = _phase(seconds, fps, 0.75)
    up = ease(seconds, fps, 0.8)
    sway = 0.02 * up * (1 + 0.15 * (phase / 3).sin())
    hang = torch.ones_like(up)
    pose = _Pose(len(phase))
    pose.stand_relaxed(sway / leg, hang)
    pose.turn(COLLARS[1], z=-0.12 * up)
    pose.turn(SHOULDERS[1], x=-1.45 * up, z=HANG - (HANG + 0.12) * up, y=0.25 * up, order="yzx")
    pose.turn(ELBOWS[1], y=0.25 + up * (1.1 + 0.45 * phase.sin()))
    pose.turn(WRISTS[1], z=0.1 * up * phase.sin())
    pose.turn(SPINE[1], z=0.04 * up)
    pose.turn(HEAD, z=-0.1 * up, y=-0.1 * up)
    return pose.motion(shift=sway, leg=leg)


def squats(seconds: float, fps: float, leg: float = LEG) -> Motion:
    """Down and up with the arms forward, heels on the floor, the trunk leaning over the feet."""
    phase = _phase(seconds, fps, 2.0)
    down = (1 - phase.cos()) / 2
    lean, thigh, knee = 0.5 * down, 1.2 * down, 1.75 * down
    apart = (0.16 / (thigh.cos() + (knee - thigh).cos())).asin()  # wider as the leg folds: the feet stay where they are
    pose = _Pose(len(phase))
    pose.orient[:, 0] = lean
    for i, side in SIDES:
        pose.turn(HIPS[i], x=-thigh - lean, z=side * apart)
        pose.turn(KNEES[i], x=knee)
        pose.turn(ANKLES[i], x=thigh - knee, z=-side * apart)
        pose.turn(SHOULDERS[i], x=-1.5 * down, z=torch.full_like(down, -side * HANG), order="xz")
        pose.turn(ELBOWS[i], y=-side * 0.2 * torch.ones_like(down))
    pose.turn(SPINE[0], x=0.1 * down)
    pose.turn(HEAD, x=-0.35 * down)
    return pose.motion(leg=leg, stand=True)


def count_to_five(seconds: float, fps: float, leg: float = LEG) -> Motion:
    """Standing, the right hand raised beside the head, its palm ahead, where all its fingers are seen; see `gestures`."""
    up = ease(seconds, fps, 0.8)
    sway = 0.015 * up * (times(seconds, fps) * 2 * math.pi).sin()
    hang = torch.ones_like(up)
    pose = _Pose(len(up))
    pose.stand_relaxed(sway / leg, hang)
    pose.turn(SHOULDERS[1], x=-1.5 * up, z=HANG - (HANG - 0.7) * up, order="zx")
    pose.turn(ELBOWS[1], y=0.25 + 2.0 * up)
    pose.turn(HEAD, y=-0.08 * up)
    return pose.motion(shift=sway, leg=leg)


def say_a_sentence(seconds: float, fps: float, leg: float = LEG) -> Motion:
    """Standing and talking: the head nods and turns a little, the forearms go along; the mouth is in `gestures`."""
    up, phase = ease(seconds, fps, 0.5), _phase(seconds, fps, 1.3)
    pose = _Pose(len(up))
    for i, side in SIDES:
        pose.turn(SHOULDERS[i], z=-side * (HANG - 0.05 * up), x=-0.15 * up, order="xz")
        pose.turn(ELBOWS[i], y=-side * (0.25 + up * (0.9 + 0.25 * (phase + side).sin())))
    pose.turn(HEAD, x=0.06 * up * (2 * phase).sin(), y=0.1 * up * phase.sin(), z=0.03 * up * phase.cos())
    pose.turn(SPINE[2], y=0.03 * up * phase.sin())
    return pose.motion(leg=leg)


MOTIONS: dict[str, Callable[..., Motion]] = {
    "jumping_jacks": jumping_jacks,
    "walk_in_place": walk_in_place,
    "wave": wave,
    "squats": squats,
}
"""Motions of the body alone."""

GESTURED: dict[str, Callable[..., Motion]] = {"count_to_five": count_to_five, "say_a_sentence": say_a_sentence}
"""Those for people with fingers and a face, whose movements are in `gestures`."""


class _Pose:
    """Local rotations of F frames, set joint by joint, and the translation that keeps the feet on the floor."""

    def __init__(self, frames: int):
        self.orient = torch.zeros(frames, 3, dtype=torch.float64)
        self.turns = torch.zeros(frames, 24, 3, dtype=torch.float64)

    def turn(self, joint: int, order: str = "zyx", **angles: Tensor) -> None:
        """Set a joint to turns about its axes; in "zyx" x comes first, z last."""
        matrix = torch.eye(3, dtype=torch.float64)
        for axis in order:
            if axis in angles:
                about = torch.zeros_like(self.orient)
                about[:, "xyz".index(axis)] = angles[axis]
                matrix = matrix @ matrix_from_rotvec(about)
        self.turns[:, joint] = rotvec_from_matrix(matrix)

    def stand_relaxed(self, sway: Tensor, hang: Tensor) -> None:
        """Legs that lean by `sway` [F] rad with the soles flat, and the left arm hanging as far as `hang` [F], from 0 to 1."""
        for i, _ in SIDES:
            self.turn(HIPS[i], z=-sway)
            self.turn(ANKLES[i], z=sway)
        self.turn(SHOULDERS[0], z=-HANG * hang, x=-0.05 * hang, order="xz")
        self.turn(ELBOWS[0], y=-0.25 * hang)

    def motion(self, leg: float, lift: Tensor | float = 0, shift: Tensor | float = 0, stand: bool = False) -> Motion:
        """The motion, lowest sole `lift` over the floor, pelvis moved by `shift` along x; `stand`: soles stay put."""
        soles = self._soles(leg)
        transl = torch.zeros_like(self.orient)
        lowest = -(-soles[..., 1] * 200).logsumexp(1) / 200  # a smooth minimum, within 7 mm
        transl[:, 0] = shift
        transl[:, 1] = lowest[0] - lowest + lift
        if stand:
            transl[:, 2] = (soles[:1, :, 2] - soles[..., 2]).mean(1)
        return self.orient.float(), self.turns[:, 1:].flatten(1).float(), transl.float()

    def _soles(self, leg: float) -> Tensor:
        """Heel and ball of both feet [F,4,3] relative to the pelvis, for a leg bent in its middle."""
        points = []
        root = matrix_from_rotvec(self.orient)
        for i, side in SIDES:
            hip = root @ matrix_from_rotvec(self.turns[:, HIPS[i]])
            knee = hip @ matrix_from_rotvec(self.turns[:, KNEES[i]])
            foot = knee @ matrix_from_rotvec(self.turns[:, ANKLES[i]])
            half = torch.tensor([0, -leg / 2, 0], dtype=torch.float64)
            ankle = root @ torch.tensor([side * 0.11, -0.03, 0], dtype=torch.float64) + hip @ half + knee @ half
            for sole in ([0, -0.07, -0.05], [0, -0.07, 0.14]):
                points.append(ankle + foot @ torch.tensor(sole, dtype=torch.float64))
        return torch.stack(points, 1)


def times(seconds: float, fps: float) -> Tensor:
    """Frames [F] as shares of the whole time, from 0 on; ValueError for less than two."""
    frames = round(seconds * fps)
    if frames < 2:
        raise ValueError(f"{seconds} s at {fps} frames per second is less than two frames")
    return torch.arange(frames, dtype=torch.float64) / frames


def _phase(seconds: float, fps: float, period: float) -> Tensor:
    """Angle [F] running through whole turns of about `period` seconds each, so that the motion can loop."""
    return times(seconds, fps) * 2 * math.pi * max(1, round(seconds / period))


def ease(seconds: float, fps: float, ramp: float) -> Tensor:
    """0 at both ends, 1 between, with smooth ramps of `ramp` seconds (less in short motions)."""
    t = times(seconds, fps) * seconds
    x = (torch.minimum(t, seconds - t) / min(ramp, seconds / 2)).clamp(0, 1)
    return x * x * (3 - 2 * x)

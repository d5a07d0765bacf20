"""Records of fingers, faces and motions, as `records` has those of all else: plain arrays with names, shapes and units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

FINGER_NAMES = tuple(
    f"{side}_{finger}{part}"
    for side in ("left", "right")
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for part in (1, 2, 3)
)
"""The 30 finger bones in SMPL-X's order; the first of each finger hangs on joint 22, left_hand, or 23, right_hand."""
FACE_NAMES = tuple(
    """browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft
    cheekSquintRight eyeBlinkLeft eyeBlinkRight eyeLookDownLeft eyeLookDownRight eyeLookInLeft eyeLookInRight
    eyeLookOutLeft eyeLookOutRight eyeLookUpLeft eyeLookUpRight eyeSquintLeft eyeSquintRight eyeWideLeft
    eyeWideRight jawForward jawLeft jawOpen jawRight mouthClose mouthDimpleLeft mouthDimpleRight mouthFrownLeft
    mouthFrownRight mouthFunnel mouthLeft mouthLowerDownLeft mouthLowerDownRight mouthPressLeft mouthPressRight
    mouthPucker mouthRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper mouthSmileLeft
    mouthSmileRight mouthStretchLeft mouthStretchRight mouthUpperUpLeft mouthUpperUpRight noseSneerLeft
    noseSneerRight tongueOut""".split()
)
"""The 52 shapes of a face, named as face capture does."""


def face_names(count: int) -> tuple[str, ...]:
    """Names of the `count` shapes of a face, at least 52: FACE_NAMES, then expression1, expression2 and so on, a body's own."""
    return FACE_NAMES + tuple(f"expression{k + 1}" for k in range(count - len(FACE_NAMES)))


@dataclass(frozen=True)
class HandsFace:
    """What a body of V vertices has beyond SMPL: finger bones, and K shapes of a face, of no points (M = 0) in SMPL-H.

    finger_regressor[40,V] x vertices at rest are the 30 joints of FINGER_NAMES and the 10 tips of those fingers;
    finger_weights[V,30] is what they take of the weights of joints 22 and 23. face_points[M,3] m lie on the head of the mean
    body at rest, and face_shapes[K,M,3] m are how the shapes of `face_names(K)` move them at coefficient 1; float32.
    """

    finger_regressor: np.ndarray
    finger_weights: np.ndarray
    face_points: np.ndarray
    face_shapes: np.ndarray

    def sized(self, factor: float) -> HandsFace:
        """Those of the same body `factor` times as large."""
        points, shapes = (part * np.float32(factor) for part in (self.face_points, self.face_shapes))
        return replace(self, face_points=points, face_shapes=shapes)


@dataclass(frozen=True)
class Fingers:
    """The 30 finger bones of an avatar, as FINGER_NAMES: joints[30,3] and tips[10,3] m at rest, where all fingers have the pose 0.

    `shape` [2,15,3] rad is the pose in which the hands lie in the avatar; shares[M,30] is what of the weights of its Gaussians
    `rows` [M] goes from joints 22 and 23 to the fingers. Without a pose of hands they stay with those joints.
    """

    joints: np.ndarray
    tips: np.ndarray
    shape: np.ndarray
    rows: np.ndarray
    shares: np.ndarray


@dataclass(frozen=True)
class Face:
    """How an avatar's face moves: the Gaussians `rows` [M] by moves[K,M,3] m at rest for coefficient 1 of each of K shapes.

    They are those of `face_names(K)`, at least 52.
    """

    rows: np.ndarray
    moves: np.ndarray


@dataclass(frozen=True)
class HandPoses:
    """Fingers of a body in F frames, of the left and the right hand.

    `names` [F]; `turns` [F,2,15,3] rad of the bones as `avatar.body.fingers` takes them, 0: as at rest; `shape` [2,15,3] is their
    median over the frames in which they are read, the pose in which a rigid hand learns. `read` [F,2]: the picture of that frame
    shows them; `error` [F,2] m: how far a finger's joint is probably off, 0 for a hand that no frame shows; `length` [F,2] px of
    the hand in the picture, wrist to tip.
    """

    names: tuple[str, ...]
    turns: np.ndarray
    shape: np.ndarray
    read: np.ndarray
    error: np.ndarray
    length: np.ndarray


@dataclass(frozen=True)
class Move:
    """A motion in the world of a clip, F poses at `fps` frames a second.

    `rotvecs` [F,72] rad, the root's first, and `steps` [F,3] m: global_orient, body_pose and transl of `BodyPoses`. `hands`
    [F,2,15,3] rad, as FINGER_NAMES, and coefficients `face` [F,K], as `face_names(K)`, where it has some.
    """

    name: str
    fps: float
    rotvecs: np.ndarray
    steps: np.ndarray
    hands: np.ndarray | None = None
    face: np.ndarray | None = None

"""Where a motion stands: which way is up, facing ahead, feet on the floor. float64, no files."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import grey_opening
from scipy.spatial.transform import Rotation

from stages import records
from stages.avatar.body.joints import ANKLES, FEET, HIPS
from stages.avatar.body.skinning import all_bones
from stages.avatar.body.smpl import Body
from stages.avatar.motion.hands import matrices
from stages.avatar.motion.hands import rotvecs as rotvecs_of
from stages.avatar.motion.retarget import Performance, leg_of
from stages.gestures import FINGER_NAMES

UPS = {"y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1), "-z": (0, 0, -1)}
SURE = 0.8
"""Least cosine between the pelvis's mean up and an axis that counts as up: 37 degrees."""
SOLE = 0.03
"""The sole is all skin less than this over the feet's lowest point at rest, m."""
SOLID = 0.3
"""Opacity from which a Gaussian counts as skin."""
STRAY = 0.01
"""The share of the feet's Gaussians, the lowest, that may hang below the sole: a floater does not lift the person."""
SOLE_POINTS = 150
"""At most so many points of the skin of both soles are followed; long motions need memory for each."""
FLIGHT = 0.7
"""Nobody is in the air for longer, s: a jump 0.6 m high. What floats for longer is a drift of the capture."""


class Placed(NamedTuple):
    """A motion for a body of known shape: y up, floor at y = 0, the first frame over the origin and facing +z.

    global_orient [F,3] and body_pose [F,69] rad, transl [F,3] m; `drift` m: the range of the floor's heights
    in the motion itself. `hands` [F,2,15,3] rad and `face` [F,K], where it has some.
    """

    global_orient: np.ndarray
    body_pose: np.ndarray
    transl: np.ndarray
    drift: float
    hands: np.ndarray | None = None
    face: np.ndarray | None = None


def mean_up(orients: np.ndarray) -> np.ndarray:
    """The direction [3] in which bodies turned by the rotation vectors `orients` [F,3] point on average, of length 1."""
    up = Rotation.from_rotvec(orients).apply([0.0, 1.0, 0.0]).mean(0)
    return up / np.linalg.norm(up)


def which_is_up(motion: Performance) -> str | None:
    """The key of UPS nearest to the pelvis's mean up, or None where none is SURE: people mostly stand."""
    mean = motion.rotations[:, 0, :, 1].mean(0)
    name = max(UPS, key=lambda up: mean @ UPS[up])
    return name if mean @ UPS[name] > SURE else None


def face_ahead(motion: Performance, up: str) -> Performance:
    """The motion with y up, turned so that its first frame looks along +z, and moved over the origin."""
    back = {"y": [0, 0, 0], "-y": [np.pi, 0, 0], "z": [-np.pi / 2, 0, 0], "-z": [np.pi / 2, 0, 0]}[up]
    turn = Rotation.from_rotvec(back)
    pelvis = turn.as_matrix() @ motion.rotations[0, 0]
    ahead = np.cross(pelvis[:, 0], [0, 1, 0])  # across the hips, whatever the trunk does
    if np.linalg.norm(ahead) < 0.1:
        ahead = pelvis[:, 2]  # lying on a side
    turn = (Rotation.from_rotvec([0, -np.arctan2(ahead[0], ahead[2]), 0]) * turn).as_matrix()
    rotations = motion.rotations.copy()
    rotations[:, 0] = turn @ rotations[:, 0]
    hips = motion.hips @ turn.T
    return motion._replace(rotations=rotations, hips=hips - hips[0] * [1, 0, 1])


class Soles:
    """The soles of a body of one shape, as points of its skin."""

    def __init__(self, body: Body, betas: np.ndarray):
        """`body` is float64; `betas` [10] give it its shape. `floor` m: how high the lowest sole is at rest."""
        self.betas = torch.as_tensor(betas, dtype=torch.float64)
        skin, joints = body.rest(self.betas)
        feet = body.lbs_weights[:, [*ANKLES, *FEET]].sum(1) > 0.5
        self.floor = skin[feet, 1].min().item()
        points = (feet & (skin[:, 1] < self.floor + SOLE)).nonzero()[:, 0]
        self.joints, self.body = joints.numpy(), body.subset(points[:: len(points) // SOLE_POINTS + 1])

    @classmethod
    def of_model(cls, model: records.BodyModel, betas: np.ndarray) -> Soles:
        """The soles of a body model's skin."""
        return cls(Body(model, torch.float64), betas)

    @classmethod
    def of_rig(cls, rig: records.Rig) -> Soles:
        """The soles of an avatar's own Gaussians, as the skeleton alone moves them; of an avatar without feet, its joints."""
        f64 = torch.float64
        feet = np.isin(rig.bones[:, 0], [*ANKLES, *FEET]) & (rig.opacities > SOLID)
        heights = rig.means[feet, 1]
        kept = np.flatnonzero(feet)[heights >= np.quantile(heights, STRAY)] if len(heights) else feet.nonzero()[0]
        joints, stiff = torch.as_tensor(rig.joints, dtype=f64), torch.eye(len(rig.joints), dtype=f64)
        points = torch.cat([torch.as_tensor(rig.means[kept], dtype=f64), joints])
        own = 0 if rig.clothes is None else len(rig.clothes.centres)
        bones = len(joints) + own + len(FINGER_NAMES)
        share = torch.as_tensor(all_bones(rig.bones8[kept], rig.words8[kept], bones))[:, : len(joints)]
        weights = torch.cat([share / share.sum(1, keepdim=True), stiff])
        return cls(Body.still(points, weights, joints, rig.parents.tolist()), rig.betas)

    def at_rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Points of the soles [P,3] m in the T-pose and their skinning weights [P,24]."""
        return self.body.rest(self.betas)[0].numpy(), self.body.lbs_weights.numpy()

    def at(self, orient: np.ndarray, pose: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points of the soles [F,P,3] and all joints [F,24,3] for orient [F,3], pose [F,69] rad, transl [F,3] m."""
        points, joints = self.body(self.betas, *(torch.as_tensor(part).double() for part in (orient, pose, transl)))
        return points.numpy(), joints.numpy()


def on_floor(motion: Performance, fps: float, soles: Soles) -> Placed:
    """A motion with y up for the body of `soles`: steps scaled by the length of its legs, a sole on the floor or over it.

    The floor is a grey opening (morphology) of the lowest sole's height over FLIGHT: never above the sole, equal to it
    where a foot stands or slowly floats, level under a jump.
    """
    rotvecs = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 72)
    orient, pose = rotvecs[:, :3], rotvecs[:, 3:]
    points, joints = soles.at(orient, pose, np.zeros_like(motion.hips))
    transl = motion.hips * (leg_of(soles.joints) / motion.leg) - joints[:, HIPS].mean(1)
    lowest = points[..., 1].min(1) + transl[:, 1]
    floor = grey_opening(lowest, size=1 + 2 * int(FLIGHT * fps / 2), mode="nearest")
    transl[:, 1] -= floor
    hands = None if motion.hands is None else rotvecs_of(motion.hands)
    return Placed(orient, pose, transl, float(np.ptp(floor)), hands, motion.face)


def seen_in_order(body: records.BodyPoses, times: np.ndarray) -> np.ndarray:
    """The frames that show the person, in the order of `times` [F] s, one of each moment that several cameras took."""
    seen = np.flatnonzero(body.confidence > 0)
    seen = seen[np.argsort(times[seen], kind="stable")]
    return seen[np.diff(times[seen], prepend=-np.inf) > 0]


def filmed(body: records.BodyPoses, rows: np.ndarray, ground: records.Ground, soles: Soles) -> Performance:
    """What the person did in frames `rows` of their clip, seen from its floor: y up, floor at y = 0, z ahead."""
    back = Rotation.from_matrix(ground.turn.T)
    rotvecs = np.concatenate([body.global_orient[rows], body.body_pose[rows]], 1).reshape(-1, 3)
    rotations = Rotation.from_rotvec(rotvecs).as_matrix().reshape(len(rows), -1, 3, 3)
    _, joints = soles.at(body.global_orient[rows], body.body_pose[rows], body.transl[rows])
    rotations[:, 0] = back.as_matrix() @ rotations[:, 0]
    hands = None if body.hands is None else matrices(body.hands[rows])
    face = None if body.face is None else body.face[rows]
    return Performance(rotations, back.apply(joints[:, HIPS].mean(1) - ground.point), leg_of(soles.joints), hands, face)


def put(
    placed: Placed, turn: np.ndarray, place: np.ndarray, pelvis: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """global_orient [F,3], body_pose [F,69] and transl [F,3] m in a world, into which `turn` [3,3] and then `place` [3] m
    take the motion. `pelvis` [3] m is the body's at rest, about which it turns.
    """
    orient = (Rotation.from_matrix(turn) * Rotation.from_rotvec(placed.global_orient)).as_rotvec()
    return orient, placed.body_pose, place - pelvis + (placed.transl + pelvis) @ turn.T

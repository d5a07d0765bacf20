"""Where the body fit starts: joint rotations read off the landmarks' limb directions, and the root's place by least squares."""

from __future__ import annotations

import numpy as np

from stages.avatar.motion.between import between
from stages.estimators.bodyfit.evidence import LandmarkEvidence
from stages.records import JOINT_NAMES

LIMBS = (
    ("left_shoulder", "left_elbow", "left_wrist", (0.0, -1.0, 0.0)),
    ("right_shoulder", "right_elbow", "right_wrist", (0.0, 1.0, 0.0)),
    ("left_hip", "left_knee", "left_ankle", (1.0, 0.0, 0.0)),
    ("right_hip", "right_knee", "right_ankle", (1.0, 0.0, 0.0)),
)
"""Root, middle and end of each limb, and the axis in the T-pose about which its middle joint bends."""
STRAIGHT = 0.3  # sine of the bend under which a limb's plane is not trusted
HIDDEN = 0.3  # visibility under which BlazePose guesses: an arm behind the body is put before it


def start_pose(evidence: LandmarkEvidence, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root rotations [F,3,3] (camera from body) and local joint rotations [F,23,3,3] of each seen frame.

    From the directions between the world landmarks and the rest `joints` [24,3]; frames not seen get the identity.
    """
    count = len(evidence.seen)
    at = {name: evidence.world[:, k] for k, name in enumerate(evidence.names)}
    rest = {name: joints[i] for i, name in enumerate(JOINT_NAMES)}
    across = normalize(
        normalize(at["left_hip"] - at["right_hip"]) + normalize(at["left_shoulder"] - at["right_shoulder"])
    )
    up = normalize(at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"])
    root = rotations_of_axes(up, across) @ rotations_of_axes(np.array([0.0, 1, 0]), np.array([1.0, 0, 0])).T
    local = np.tile(np.eye(3), (count, 23, 1, 1))
    for start, middle, end, axis in LIMBS:
        upper, lower = normalize(at[middle] - at[start]), normalize(at[end] - at[middle])
        rest_upper = normalize(rest[middle] - rest[start])
        rest_axis = normalize(np.array(axis) - (np.array(axis) @ rest_upper) * rest_upper)
        plain = root @ rest_axis
        bent = np.cross(upper, lower)
        trusted = np.clip(np.linalg.norm(bent, axis=-1, keepdims=True) / STRAIGHT, 0, 1)
        if middle.endswith("knee"):  # a knee that bends forward is noise
            trusted = trusted * ((bent * plain).sum(-1, keepdims=True) > 0)
        hinge = normalize(trusted * normalize(bent) + (1 - trusted) * plain)
        hinge = np.where(np.abs((hinge * upper).sum(-1, keepdims=True)) > 0.98, normalize(np.cross(upper, up)), hinge)
        whole = rotations_of_axes(upper, hinge) @ rotations_of_axes(rest_upper, rest_axis).T
        local[:, JOINT_NAMES.index(start) - 1] = root.transpose(0, 2, 1) @ whole
        angle = np.arctan2(np.linalg.norm(bent, axis=-1), (upper * lower).sum(-1)) * trusted[:, 0]
        local[:, JOINT_NAMES.index(middle) - 1] = rotations_about(rest_axis, angle)
    root[~evidence.seen], local[~evidence.seen] = np.eye(3), np.eye(3)
    return root, local


def fill_limbs(pose: np.ndarray, evidence: LandmarkEvidence, times: np.ndarray) -> np.ndarray:
    """Local rotation vectors [F,23,3] in which limbs that hide turn evenly between the frames that show them.

    Started from a guess, a hidden arm may stay on the wrong side of the body: only its jump has a cost, which is
    bounded. Before the first and after the last frame that shows it the guesses stay. `times` [F] s.
    """
    filled = pose.copy()
    for *limb, _ in LIMBS:
        shown = np.flatnonzero(evidence.weight[:, [evidence.column(name) for name in limb]].min(1) > HIDDEN)
        turning = [JOINT_NAMES.index(name) - 1 for name in limb[:2]]
        if len(shown):
            known = unwrap_rotations(pose[shown][:, turning]).reshape(len(shown), -1)
            within = times[shown[0] : shown[-1] + 1]
            filled[shown[0] : shown[-1] + 1, turning] = between(within, times[shown], known).reshape(-1, 2, 3)
    return filled


def solve_places(points: np.ndarray, xy: np.ndarray, weight: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Translations [F,3] m that bring camera-axes `points` [F,K,3] onto pixels `xy` [F,K,2], by weighted least squares.

    Three rounds, each trusting a point less the further off it was; never nearer than half a metre.
    """
    shifts = np.zeros((len(points), 3))
    for i in range(len(points)):
        rays = (xy[i] - K[i, :2, 2]) / K[i, [0, 1], [0, 1]]
        trust = weight[i].copy()
        for _ in range(4):
            rows = np.zeros((len(rays), 2, 3))
            rows[:, 0, 0] = rows[:, 1, 1] = 1
            rows[..., 2] = -rays
            right = rays * points[i, :, 2:] - points[i, :, :2]
            solved, *_ = np.linalg.lstsq((rows * trust[:, None, None]).reshape(-1, 3), (right * trust[:, None]).ravel())
            shifts[i] = solved
            depth = points[i, :, 2] + solved[2]
            off = np.linalg.norm((rows @ solved - right), axis=-1) / np.maximum(depth, 0.5)
            spread = max(1e-3, 1.5 * np.median(off[weight[i] > 0])) if (weight[i] > 0).any() else 1.0
            trust = weight[i] / (1 + (off / spread) ** 2)
    shifts[:, 2] = np.maximum(shifts[:, 2], 0.5)
    return shifts


def fill_poses(
    orient: np.ndarray, place: np.ndarray, pose: np.ndarray, known: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World root rotations [M,3], places [M,3] and pose [M,69] at times `known` [M] s, at all `times` [F] s.

    Straight lines between neighbours, of rotation vectors that take the short way; held at both ends.
    """
    turns = unwrap_rotations(np.concatenate([orient, pose], 1).reshape(len(known), -1, 3)).reshape(len(known), -1)
    filled = between(times, known, np.concatenate([turns, place], 1))
    return filled[:, :3], filled[:, -3:], filled[:, 3:-3]


def unwrap_rotations(rotvecs: np.ndarray) -> np.ndarray:
    """The same rotations [F,J,3] with a whole turn taken off a vector where that is nearer to the frame before."""
    out = rotvecs.copy()
    for i in range(1, len(out)):
        angle = np.linalg.norm(out[i], axis=-1, keepdims=True)
        other = out[i] - np.where(angle > 1e-6, out[i] / np.maximum(angle, 1e-6) * 2 * np.pi, 0)
        nearer = np.linalg.norm(other - out[i - 1], axis=-1) < np.linalg.norm(out[i] - out[i - 1], axis=-1)
        out[i] = np.where(nearer[:, None], other, out[i])
    return out


def normalize(v: np.ndarray) -> np.ndarray:
    """Vectors [...,3] scaled to length 1; a zero vector stays zero."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def rotations_of_axes(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rotations [...,3,3] whose first column is `first` and whose second is `second` made square to it."""
    second = normalize(second - (first * second).sum(-1, keepdims=True) * first)
    return np.stack(np.broadcast_arrays(first, second, np.cross(first, second)), -1)


def rotations_about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations [F,3,3] about one unit `axis` [3] by `angle` [F] rad."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, rest = np.sin(angle)[:, None, None], (1 - np.cos(angle))[:, None, None]
    return np.eye(3) + sine * cross + rest * (cross @ cross)

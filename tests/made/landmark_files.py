"""Landmarks of BlazePose's 33 points in the layouts that programs write, from true places [F,33,2] px (NaN: not known)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stages.formats.given_landmarks.skeletons import SKELETONS
from stages.formats.landmarks import NAMES

Writer = Callable[[Path, np.ndarray], Path]
PERSON = {
    "nose": (0, 0), "left_eye": (3, -3), "left_ear": (7, 0), "left_shoulder": (20, 20), "left_elbow": (30, 50),
    "left_wrist": (34, 78), "left_pinky": (34, 86), "left_index": (37, 86), "left_hip": (12, 80), "left_knee": (15, 125),
    "left_ankle": (16, 168), "left_heel": (15, 174), "left_foot_index": (22, 178),
}  # fmt: skip


def somebody(count: int) -> np.ndarray:
    """Places [count,33,2] px of somebody who sways, the right side a little lower than the left."""
    rows = np.full((count, 33, 2), np.nan)
    for name, (x, y) in PERSON.items():
        for side, sign in (("left", 1), ("right", -1)):
            rows[:, NAMES.index(name.replace("left", side))] = (300 + sign * x, 100 + y + (side == "right"))
    return rows + 3.0 * np.arange(count)[:, None, None] ** [1, 0.5]


def ordered(skeleton: str, points: np.ndarray) -> np.ndarray:
    """The points [F,33,D] in a skeleton's order [F,K,D], NaN for those that are none of ours."""
    void = np.full(points[:, 0].shape, np.nan)
    return np.stack([points[:, NAMES.index(name)] if name else void for name in SKELETONS[skeleton]], 1)


def triples(skeleton: str, points: np.ndarray, sure: float = 0.9) -> np.ndarray:
    """x, y, confidence [F,K,3]; what is not known is 0, 0, 0."""
    placed = ordered(skeleton, points)
    return np.nan_to_num(np.concatenate([placed, np.where(np.isfinite(placed[..., :1]), sure, np.nan)], -1))


def openpose(folder: Path, points: np.ndarray, skeleton: str = "OpenPose BODY_25", hands: bool = False) -> Path:
    """A file a picture, as --write_json of OpenPose and Pose2Sim make it."""
    folder.mkdir(parents=True)
    whole = SKELETONS[skeleton]
    left, right = (
        (triples(f"{skeleton} and hands", points)[:, len(whole) :][:, k : k + 21] for k in (0, 21))
        if hands
        else ((), ())
    )
    for i, row in enumerate(triples(skeleton, points)):
        person = {"person_id": [-1], "pose_keypoints_2d": row.ravel().tolist(), "face_keypoints_2d": []}
        person["hand_left_keypoints_2d"] = left[i].ravel().tolist() if hands else []
        person["hand_right_keypoints_2d"] = right[i].ravel().tolist() if hands else []
        content = {"version": 1.3, "people": [person]}
        (folder / f"clip_{i:012d}_keypoints.json").write_text(json.dumps(content))
    return folder


def mmpose(path: Path, points: np.ndarray, skeleton: str = "COCO-17", first: int = 1, inside: bool = True) -> Path:
    """--save-predictions of MMPose's demos (frames from 1), or of its inferencer (from 0, a plain list)."""
    rows = [
        {
            "frame_id": i + first,
            "instances": [{"keypoints": row[:, :2].tolist(), "keypoint_scores": row[:, 2].tolist()}],
        }
        for i, row in enumerate(triples(skeleton, points))
    ]
    path.write_text(json.dumps({"meta_info": {"dataset_name": "coco"}, "instance_info": rows} if inside else rows))
    return path


def sapiens(folder: Path, points: np.ndarray, skeleton: str = "Sapiens-308") -> Path:
    """A file a picture, as vis_pose.py of Sapiens makes it."""
    folder.mkdir(parents=True)
    for i, row in enumerate(triples(skeleton, points)):
        person = {"keypoints": row[:, :2].tolist(), "keypoint_scores": row[:, 2].tolist()}
        (folder / f"{i:05d}.json").write_text(json.dumps({"instance_info": [person]}))
    return folder


def alphapose(path: Path, points: np.ndarray, skeleton: str = "Halpe-136", others: tuple[np.ndarray, ...] = ()) -> Path:
    """alphapose-results.json; `others` are further people, each with an id from 2 on."""
    rows = [
        {"image_id": f"{i}.jpg", "category_id": 1, "keypoints": row.ravel().tolist(), "score": 2.9, "idx": who}
        for who, each in enumerate((points, *others), 1)
        for i, row in enumerate(triples(skeleton, each))
    ]
    path.write_text(json.dumps(rows))
    return path


def vitpose(path: Path, points: np.ndarray) -> Path:
    """--save-json of easy_ViTPose: y, x, confidence, with the points' names."""
    skeleton = {str(k): name or f"other {k}" for k, name in enumerate(SKELETONS["COCO-23"])}
    frames = [{"0": row[:, [1, 0, 2]].tolist()} for row in triples("COCO-23", points)]
    path.write_text(json.dumps({"keypoints": frames, "skeleton": skeleton}))
    return path


CALLED = (
    "Nose",
    "LShoulder",
    "RShoulder",
    "LElbow",
    "RElbow",
    "LWrist",
    "RWrist",
    "LHip",
    "RHip",
    "LKnee",
    "RKnee",
    "LAnkle",
)
CALLED = (*CALLED, "RAnkle", "LBigToe", "RBigToe", "LHeel", "RHeel")
OURS = [NAMES.index(name) for name in ("nose", *(f"{s}_{p}" for p in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle",
        "foot_index", "heel") for s in ("left", "right")))]  # fmt: skip


def deeplabcut(path: Path, points: np.ndarray) -> Path:
    """The .csv of analyze_videos(save_as_csv=True)."""
    head = ["scorer", "bodyparts", "coords"]
    names = [["net"] * 3 * len(CALLED), [c for c in CALLED for _ in range(3)], ["x", "y", "likelihood"] * len(CALLED)]
    lines = [",".join([first, *cells]) for first, cells in zip(head, names, strict=True)]
    for i, row in enumerate(points[:, OURS]):
        values = np.concatenate([row, np.where(np.isfinite(row[:, :1]), 0.9, 0.0)], 1)
        lines.append(",".join([str(i), *(f"{v:.6f}" for v in values.ravel())]))
    path.write_text("\n".join(lines) + "\n")
    return path


def trc(path: Path, world: np.ndarray, fps: float) -> Path:
    """The .trc of Pose2Sim: metres, by time."""
    table = world[:, OURS].reshape(len(world), -1)
    lines = ["PathFileType\t4\t(X/Y/Z)\tclip.trc"]
    lines += ["DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"]
    lines += [f"{fps}\t{fps}\t{len(table)}\t{len(CALLED)}\tm\t{fps}\t0\t{len(table)}"]
    lines += ["Frame#\tTime\t" + "\t\t\t".join(CALLED) + "\t\t"]
    lines += ["\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(CALLED)) for axis in "XYZ")]
    lines += ["\t".join([str(i), f"{i / fps:.6f}", *(f"{v:.6f}" for v in row)]) for i, row in enumerate(table)]
    path.write_text("\n".join(lines) + "\n")
    return path


def arrays(path: Path, points: np.ndarray, **more: np.ndarray) -> Path:
    """RTMLib's keypoints and scores, saved with numpy."""
    rows = triples("Halpe-26", points)
    np.savez(path, keypoints=rows[..., :2], scores=rows[..., 2], **more)
    return path


def blazepose(path: Path, points: np.ndarray, size: tuple[int, int]) -> Path:
    """MediaPipe's pose_landmarks as [F,33,4]: x, y, z as shares of the picture, visibility."""
    shares = points / size
    np.save(path, np.concatenate([shares, 0 * shares[..., :1], 0.9 + 0 * shares[..., :1]], -1))
    return path


WRITERS: dict[str, tuple[str, Writer]] = {
    "OpenPose": ("openpose", openpose),
    "OpenPose with hands": ("openpose", lambda path, points: openpose(path, points, hands=True)),
    "Pose2Sim Halpe-26": ("pose", lambda path, points: openpose(path, points, "Halpe-26")),
    "MMPose demo": ("results.json", mmpose),
    "MMPose inferencer": ("clip.json", lambda path, points: mmpose(path, points, "COCO-WholeBody-133", 0, False)),
    "Sapiens": ("sapiens", sapiens),
    "AlphaPose": ("alphapose-results.json", alphapose),
    "AlphaPose COCO": ("coco.json", lambda path, points: alphapose(path, points, "COCO-17")),
    "ViTPose": ("vitpose.json", vitpose),
    "DeepLabCut": ("clipDLC.csv", deeplabcut),
    "RTMLib": ("rtm.npz", arrays),
}

"""Landmarks in .json, a file for a clip or one for each picture.

| program            | what is in it                                                                            |
|--------------------|------------------------------------------------------------------------------------------|
| OpenPose, Pose2Sim | a file a picture: people: pose_keypoints_2d [3K] x y c, hand_left_keypoints_2d, ...      |
| MMPose             | a list, or instance_info, of frame_id and instances: keypoints [K][2 or 3], keypoint_scores |
| Sapiens, MMPose    | a file a picture: a list, or instance_info, of keypoints and keypoint_scores             |
| AlphaPose, COCO    | a list of image_id, keypoints [3K] x y c, idx                                            |
| easy_ViTPose       | keypoints: of each frame id -> [K][3] y x c; skeleton: place -> name                     |

Sources: OpenPose doc/02_output.md, Pose2Sim poseEstimation.py, mmpose demo/topdown_demo_with_mmdet.py and apis/inferencers,
sapiens lite/demo/vis_pose.py, AlphaPose alphapose/utils/pPose_nms.py, easy_ViTPose README.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import as_array
from stages.formats.frame_names import stem
from stages.formats.given_landmarks.record import HINT, GivenLandmarks, Row, of_rows
from stages.formats.pictures import natural_order

HANDS = ("hand_left_keypoints_2d", "hand_right_keypoints_2d")
HAND = 21


def read_json_folder(folder: Path) -> GivenLandmarks:
    """A folder with a file for each picture; what has no people or instances (a list of settings) is refused by name."""
    files = sorted(folder.glob("*.json"), key=natural_order)
    tool, rows = "", []
    for file in files:
        tool, found, _ = _read(file, _picture(file))
        rows += found
    return of_rows(str(folder), tool, rows)


def read_json(path: Path) -> GivenLandmarks:
    """A file with all pictures of a clip."""
    tool, rows, names = _read(path, None)
    return of_rows(str(path), tool, rows, names)


def _picture(file: Path) -> str:
    """The picture's name in the name of its file: OpenPose and Pose2Sim append a word."""
    return stem(file.stem.removesuffix("_keypoints"))


def _read(path: Path, picture: str | None) -> tuple[str, list[Row], list[str] | None]:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise StageError(f"{path} is not valid JSON", HINT, [str(error)]) from error
    names: list[str] | None = None
    try:
        if isinstance(content, Mapping) and "people" in content:
            tool, found = "OpenPose", _openpose(content["people"], picture, str(path))
        elif isinstance(content, Mapping) and {"keypoints", "skeleton"} <= set(content):
            order = {int(place): str(name) for place, name in content["skeleton"].items()}
            names = [order[place] for place in sorted(order)]
            tool, found = "ViTPose", _vitpose(content["keypoints"], str(path))
        else:
            listed = content.get("instance_info") if isinstance(content, Mapping) else content
            if not isinstance(listed, list) or not all(isinstance(one, Mapping) for one in listed):
                raise StageError(f"{path} holds no landmarks", HINT, [f"it is {_kind(content)}"])
            alpha = any("image_id" in one for one in listed)
            tool, found = (
                ("AlphaPose", _alphapose(listed, str(path)))
                if alpha
                else ("MMPose", _mmpose(listed, picture, str(path)))
            )
        return tool, list(found), names
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise StageError(
            f"{path} does not hold landmarks in a known form", HINT, [f"{type(error).__name__}: {error}"]
        ) from error


def _kind(content: Any) -> str:
    return f"named {', '.join(map(str, list(content)[:8]))}" if isinstance(content, Mapping) else type(content).__name__


def _triples(values: Any, where: str) -> np.ndarray:
    """x, y and confidence [K,3] of a flat list; a point that was not found is at (0, 0)."""
    flat = as_array(values, "keypoints", where, HINT)
    if flat.dtype.kind not in "fiu" or flat.size % 3:
        raise StageError(f"keypoints in {where} are not x, y and confidence in turn", HINT, [f"{flat.size} values"])
    return flat.astype(np.float64).reshape(-1, 3)


def _openpose(people: Any, picture: str | None, where: str) -> Iterator[Row]:
    for person in people:
        points = _triples(person["pose_keypoints_2d"], where)
        if any(person.get(key) for key in HANDS) and len(points) in (18, 25):
            hands = [_triples(person.get(key) or np.zeros(3 * HAND), where) for key in HANDS]
            points = np.concatenate([points, *hands])
        who = np.ravel(person.get("person_id", -1))
        track = str(int(who[0])) if len(who) and who[0] >= 0 else None
        yield Row(points[:, :2], points[:, 2], name=picture or Path(where).stem, track=track)


def _vitpose(frames: Any, where: str) -> Iterator[Row]:
    for number, people in enumerate(frames):
        for track, values in people.items():
            points = _triples(np.ravel(values), where)
            yield Row(points[:, [1, 0]], points[:, 2], number=number, track=str(track))


def _alphapose(listed: list[Any], where: str) -> Iterator[Row]:
    for one in listed:
        points, who = _triples(one["keypoints"], where), np.ravel(one.get("idx", one.get("track_id", "")))
        track = str(who[0]) if len(who) else ""
        yield Row(points[:, :2], points[:, 2], name=stem(str(one["image_id"])), track=track or None)


def _mmpose(listed: list[Any], picture: str | None, where: str) -> Iterator[Row]:
    for i, one in enumerate(listed):
        frame = one.get("frame_id", i)
        for person in one.get("instances", [one]):
            points = as_array(person["keypoints"], "keypoints", where, HINT).astype(np.float64)
            points = points[0] if points.ndim == 3 else points
            scores = np.ravel(person["keypoint_scores"]) if "keypoint_scores" in person else np.ones(len(points))
            flat = points.shape[1] == 2
            track = person.get("track_id")
            yield Row(
                points if flat else None,
                scores,
                None if flat else points,
                name=picture or str(frame),
                track=None if track is None else str(track),
            )

"""Landmarks in arrays: an .npy of [frames, points, 2 to 4], or an .npz of such with names beside it.

| key                           | what                                                                              |
|-------------------------------|-----------------------------------------------------------------------------------|
| keypoints (xy, poses ...)     | [F,K,2], [F,K,3] x y confidence or x y z, [F,K,4] x y z confidence, or [F,P,K,...] |
| scores (visibility ...)       | [F,K] or [F,P,K]                                                                  |
| keypoints_3d (world)          | [F,K,3] or [F,P,K,3]                                                              |
| keypoint_names                | [K] names of the points                                                           |
| names or frame_ids, fps, times | which picture, or when, each row is                                              |
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import read_npy, read_npz, texts
from stages.formats.given_landmarks.record import HINT, GivenLandmarks, Row, of_rows

FLAT = ("keypoints", "keypoints_2d", "xy", "landmarks", "poses", "pose", "kpts")
SURE = ("scores", "keypoint_scores", "confidence", "visibility", "conf")
DEEP = ("keypoints_3d", "world", "world_landmarks", "joints_3d")
FRAMES = ("names", "frame_names", "frame_ids", "frames")


def read_arrays(path: Path) -> GivenLandmarks:
    """The arrays of one person or several; StageError where none has the shape of landmarks."""
    arrays = read_npz(path, HINT) if path.suffix.lower() == ".npz" else {"keypoints": read_npy(path, HINT)}
    flat, sure, deep = (next((arrays[key] for key in keys if key in arrays), None) for keys in (FLAT, SURE, DEEP))
    if flat is None and deep is None:
        raise StageError(f"{path} holds no landmarks", HINT, [f"it holds {', '.join(sorted(arrays)) or 'nothing'}"])
    parts = {key: _by_person(value, key, path) for key, value in (("2D", flat), ("3D", deep)) if value is not None}
    xy, more, world = _columns(parts["2D"]) if "2D" in parts else (None, None, None)
    world = parts.get("3D", world)
    some = xy if xy is not None else world
    if some is None or (world is not None and world.shape[:3] != some.shape[:3]):
        raise StageError(f"{path} has 2D and 3D landmarks that differ in the number of frames or points", HINT)
    if sure is not None:
        sizes = int(np.prod(some.shape[:3]))
        if sure.size != sizes or sure.dtype.kind not in "fiu":
            raise StageError(f"{path} has {sure.size} confidences for {sizes} points", HINT)
        more = sure.astype(np.float64).reshape(some.shape[:3])
    frames, people = some.shape[:2]
    times = _times(arrays, frames)
    key = next((key for key in FRAMES if key in arrays), None)
    names = None if key is None or times is not None else texts(arrays[key], frames, key, path, HINT)
    rows = [
        Row(
            None if xy is None else xy[i, who],
            None if more is None else more[i, who],
            None if world is None else world[i, who],
            name=None if names is None else names[i],
            number=i if names is None and times is None and people > 1 else None,
            track=str(who) if people > 1 else None,
        )
        for who in range(people)
        for i in range(frames)
    ]
    named = arrays.get("keypoint_names")
    called = None if named is None else texts(named, some.shape[2], "keypoint_names", path, HINT)
    return of_rows(str(path), "arrays", rows, called, None if times is None else np.tile(times, people))


def _by_person(array: np.ndarray, key: str, path: Path) -> np.ndarray:
    """An array as [F,P,K,D]; StageError for one that is not of landmarks."""
    if array.dtype.kind not in "fiu" or array.ndim not in (3, 4) or not 2 <= array.shape[-1] <= 4 or not array.size:
        facts = [f"{key}: {array.dtype} {array.shape}"]
        raise StageError(f"{path} has no landmarks [frames, points, 2 to 4]", HINT, facts)
    return (array if array.ndim == 4 else array[:, None]).astype(np.float64)


def _columns(points: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Places, confidences and 3D in the columns [F,P,K,D]: a third column is a depth where it is negative or beyond 100."""
    if points.shape[-1] == 2:
        return points, None, None
    if points.shape[-1] == 4:  # of BlazePose: z is as large as x, and about the hips
        middle = np.nanmedian(np.abs(np.nanmean(points[..., :2], axis=2)))
        sure = points[..., 3]
        return (None, sure, points[..., :3]) if middle < 0.1 else (points[..., :2], sure, None)
    third, places = points[..., 2], points[..., :2]
    in_metres = np.nanmax(np.abs(places), initial=0.0) < 10 and np.nanmin(places, initial=0.0) < -0.5
    if np.nanmin(third, initial=0.0) < 0 or np.nanmax(third, initial=0.0) > 100 or in_metres:
        return None, None, points
    return places, third, None


def _times(arrays: dict[str, np.ndarray], frames: int) -> np.ndarray | None:
    if "times" in arrays and arrays["times"].shape == (frames,):
        return arrays["times"].astype(np.float64)
    rate = arrays.get("fps", arrays.get("frame_rate"))
    return None if rate is None or not float(np.ravel(rate)[0]) > 0 else np.arange(frames) / float(np.ravel(rate)[0])

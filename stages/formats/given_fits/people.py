"""Fits of 4D-Humans (PHALP) and ROMP: everybody in each picture, seen by a camera of the tool's own.

Sources: PHALP phalp/trackers/PHALP.py, phalp/models/hmar/hmar.py; ROMP romp/predict/base_predictor.py and video.py,
simple_romp/romp/main.py, utils.py and post_parser.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.given_fits.record import FAR, Fields, SmplFit, join_fits, same_picture

PHALP_HINT = "give results/demo_VIDEO.pkl, as track.py of 4D-Humans writes it"
PHALP_FOCAL = 5000 / 256
"""PHALP's focal length over the side of the picture, padded to a square."""
OPENPOSE_SMPL = [12, 17, 19, 21, 16, 18, 20, 0, 2, 5, 8, 1, 4, 7]
"""SMPL's joints at places 1 to 14 of PHALP's 45."""
ROMP_HINT = "give what ROMP wrote: video_results.npz, VIDEO_results.npz, or the folder with an .npz a picture"


def read_phalp(content: dict[Any, Any], path: str, size: tuple[int, int]) -> SmplFit:
    """Picture's path -> tid, tracked_time, smpl, camera, size, 2d_joints (lists over people) and time (its number).

    `camera` [3] m is the translation before a camera of focal length PHALP_FOCAL; people of whom only a prediction is
    kept (tracked_time > 0) are left out.
    """
    fits, ghosts = [], 0
    for name, values in content.items():
        where = f"{name} of {path}"
        picture = Fields(values, where, PHALP_HINT)
        lists = {key: picture.take(key) for key in ("tid", "tracked_time", "smpl", "camera", "size")}
        number = int(picture.get("time"))
        lists |= {"2d_joints": picture.take("2d_joints")} if "2d_joints" in picture else {}
        lengths = {key: _length(value) for key, value in lists.items()}
        if None in lengths.values() or len(set(lengths.values())) > 1:
            facts = [", ".join(f"{key} {length}" for key, length in lengths.items())]
            raise StageError(f"{where} has lists of different lengths", PHALP_HINT, facts)
        for i, tid in enumerate(lists["tid"]):
            person = {key: value[i] for key, value in lists.items()}
            one = Fields(person, f"person {tid} in {where}", PHALP_HINT)
            if one.get("tracked_time") > 0:
                ghosts += 1
            else:
                fits.append(_phalp_person(one, path, str(name), number, str(tid), size))
    notes = (f"{ghosts} poses that the tracker only predicted are left out",) if ghosts else ()
    whole = join_fits(fits, path)
    return replace(whole, notes=whole.notes + notes)


def _length(value: Any) -> int | None:
    """How many entries a list or an array has, None for what is neither."""
    listed = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)
    return len(value) if listed else None


def _phalp_person(one: Fields, path: str, name: str, number: int, tid: str, size: tuple[int, int]) -> SmplFit:
    body = Fields(one.take("smpl"), f"smpl of {one.where}", PHALP_HINT)
    rotations = {key: np.asarray(body.array(key))[None] for key in ("global_orient", "body_pose")}
    stacked = Fields(rotations, body.where, PHALP_HINT)
    height, width = one.get("size", 2)
    ratio = same_picture(np.array([[width, height]]), size, one.where, PHALP_HINT)
    joints2d = np.full((1, 24, 2), np.nan)
    if "2d_joints" in one:
        square = one.get("2d_joints", 90).reshape(45, 2) * max(width, height)
        padding = np.array([(max(width, height) - width) // 2, (max(width, height) - height) // 2])
        joints2d[0, OPENPOSE_SMPL] = (square[1:15] - padding) * ratio
    return SmplFit(
        path,
        "PHALP",
        betas=body.betas("betas", 1),
        global_orient=stacked.rotations("global_orient", 1, 1),
        body_pose=stacked.rotations("body_pose", 1, 23),
        transl=one.get("camera", 3)[None],
        names=(name,),
        numbers=np.array([number]),
        tracks=(tid,),
        focal=np.array([PHALP_FOCAL * max(size)]),
        center=np.array([size]) / 2,
        joints2d=joints2d,
    )


def read_romp(content: dict[str, Any], path: str, size: tuple[int, int], name: str = "") -> SmplFit:
    """`results` of any of ROMP's files, of its first version and of simple-romp; `name` is the picture's if there is one only.

    Of a person: cam (s, tx, ty) on the picture padded to a square of -1..1, poses [72], betas [10]. The file's own
    translation is ignored: ROMP itself draws by `cam`.
    """
    results = content["results"]
    tracks, several = content.get("sequence_results"), isinstance(results, Mapping) and "cam" not in results
    people: list[tuple[Any, str | None, Any]]
    if isinstance(tracks, Mapping) and tracks:
        people = list(_tracked(tracks, results, path))
    elif several and all(isinstance(v, Mapping) and "cam" not in v and "poses" not in v for v in results.values()):
        people = [(frame, str(tid), one) for tid, frames in results.items() for frame, one in frames.items()]
    elif several:
        people = [(frame, None, one) for frame, found in results.items() for one in _apart(found, path)]
    else:
        people = [(name, None, one) for one in _apart(results, path)]
    fits = [_romp_person(one, path, str(frame), track, size) for frame, track, one in people]
    return join_fits(fits, path)


def _tracked(tracks: Mapping[Any, Any], results: Any, path: str) -> Iterator[tuple[str, str, Any]]:
    """simple-romp's sequence_results: track -> lists over its frames; frame_id counts the pictures of `results`."""
    names = list(results) if isinstance(results, Mapping) else []
    for track, lists in tracks.items():
        person = Fields(lists, f"track {track} of {path}", ROMP_HINT)
        frames = person.take("frame_id")
        short = [key for key in person.values if _length(person.values[key]) != _length(frames)]
        if short or _length(frames) is None:
            facts = [f"{(short or ['frame_id'])[0]} has not the {_length(frames)} entries of frame_id"]
            raise StageError(f"{person.where} has lists of different lengths", ROMP_HINT, facts)
        for i, frame in enumerate(frames):
            if not (isinstance(frame, int | np.integer) and 0 <= frame < len(names)):
                facts = [f"frame_id {frame!r}; there are {len(names)} pictures"]
                raise StageError(f"{person.where} names a picture that is not there", ROMP_HINT, facts)
            yield names[frame], str(track), {key: values[i] for key, values in lists.items()}


def _apart(found: Any, path: str) -> list[dict[str, Any]]:
    """The people of one picture: the first version has a list of them, simple-romp arrays with a row each."""
    if isinstance(found, list | tuple):
        return list(found)
    rows = Fields(found, f"results of {path}", ROMP_HINT)
    count = rows.count("cam")
    kept = ("cam", "smpl_thetas", "smpl_betas", "track_ids")
    lists = {key: rows.array(key) for key in kept if key in rows}
    for key, array in lists.items():
        if array.shape[:1] != (count,):
            facts = [f"{key} has shape {array.shape}, cam {count} rows"]
            raise StageError(f"{rows.where} has arrays of different lengths", ROMP_HINT, facts)
    return [{key: array[i] for key, array in lists.items()} for i in range(count)]


def _romp_person(values: Any, path: str, frame: str, track: str | None, size: tuple[int, int]) -> SmplFit:
    where = f"{frame or 'a picture'} of {path}"
    one = Fields(values, where, ROMP_HINT)
    thetas, betas = ("smpl_thetas", "smpl_betas") if "smpl_thetas" in one else ("poses", "betas")
    scale, x, y = one.get("cam", 3)
    if not scale > 0:
        raise StageError(f"cam in {where} has a scale that is not positive", ROMP_HINT, [f"it is {scale:g}"])
    pose = Fields({thetas: one.array(thetas)[None]}, where, ROMP_HINT).rotations(thetas, 1, 24)
    if track is None:
        track = str(int(one.get("track_ids"))) if "track_ids" in one else ""
    half = max(size) / 2
    return SmplFit(
        path,
        "ROMP",
        betas=one.betas(betas, 1),
        global_orient=pose[:, :3],
        body_pose=pose[:, 3:],
        transl=np.array([[x / scale, y / scale, FAR / (half * scale)]]),
        names=(Path(frame).name,),
        tracks=(track,),
        focal=np.array([FAR]),
        center=np.array([size]) / 2,
    )

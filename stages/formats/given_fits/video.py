"""Fits of WHAM, GVHMR, TRAM and PromptHMR: one track of poses a person, in the camera of each frame.

Each tool has its own world, so poses are read in the camera, and this clip's cameras place them.
Sources: WHAM demo.py and lib/utils/imutils.py, GVHMR tools/demo/demo.py, TRAM scripts/estimate_humans.py and
lib/models/hmr_vimo.py, PromptHMR pipeline/pipeline.py and phmr_vid.py.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.given_fits.record import OTHER_SHAPE, SMPLX_PELVIS, Fields, SmplFit, join_fits, same_picture
from stages.formats.tool_pickles import read_tool_file

WHAM_HINT = "give wham_output.pkl, as `python demo.py --save_pkl` of WHAM writes it"
GVHMR_HINT = "give hmr4d_results.pt, as tools/demo/demo.py of GVHMR writes it"
PROMPT_HINT = "give results.pkl, as scripts/demo_video.py of PromptHMR writes it"
TRAM_HINT = "give the folder results/VIDEO of TRAM, with camera.npy and hps/hps_track_*.npy"


def read_wham(content: dict[Any, Any], path: str, size: tuple[int, int]) -> SmplFit:
    """wham_output.pkl: id -> pose [N,72], trans [N,3], betas [N,10], frame_ids [N] (numbers of frames in the video).

    The file does not say its focal length; without calibration it is the picture's diagonal.
    """
    lens, fits = (float(np.hypot(*size)), np.array(size) / 2), []
    for track, values in content.items():
        person = Fields(values, f"track {track} of {path}", WHAM_HINT)
        count = person.count("pose")
        pose = person.rotations("pose", count, 24)
        betas, transl = person.betas("betas", count), person.get("trans", count, 3)
        numbers = _numbers(person, "frame_ids", count)
        fits.append(_track(path, "WHAM", str(track), betas, pose, transl, numbers, lens))
    return join_fits(fits, path)


def read_gvhmr(content: dict[str, Any], path: str, size: tuple[int, int]) -> SmplFit:
    """hmr4d_results.pt: smpl_params_incam (body_pose [N,63], betas, global_orient, transl of SMPL-X), K_fullimg [N,3,3].

    Row i is frame i of the video; the principal point is the picture's middle.
    """
    file = Fields(content, path, GVHMR_HINT)
    person = Fields(file.take("smpl_params_incam"), f"smpl_params_incam of {path}", GVHMR_HINT)
    count = person.count("global_orient")
    K = file.get("K_fullimg", count, 3, 3)
    ratio = same_picture(2 * K[:, :2, 2], size, path, GVHMR_HINT)
    return SmplFit(
        path,
        "GVHMR",
        betas=person.betas("betas", count),
        global_orient=person.rotations("global_orient", count, 1),
        body_pose=np.concatenate([person.rotations("body_pose", count, 21), np.zeros((count, 6))], 1),
        transl=person.get("transl", count, 3),
        numbers=np.arange(count),
        focal=_focal(K[:, 0, 0] * ratio, path, GVHMR_HINT),
        center=K[:, :2, 2] * ratio[:, None],
        pelvis=SMPLX_PELVIS,
        notes=(OTHER_SHAPE.format("SMPL-X"),),
    )


def read_tram(folder: Path, size: tuple[int, int]) -> SmplFit:
    """hps_track_*.npy: pred_rotmat [N,24,3,3], pred_trans [N,1,3], pred_shape [N,10], frame [N]; and camera.npy beside.

    camera.npy has img_focal and img_center in px of the video.
    """
    camera = Fields(read_tool_file(folder / "camera.npy", TRAM_HINT), str(folder / "camera.npy"), TRAM_HINT)
    lens, fits = _lens(camera, size), []
    for file in sorted((folder / "hps").glob("hps_track_*.npy")):
        person = Fields(read_tool_file(file, TRAM_HINT), str(file), TRAM_HINT)
        count = person.count("pred_rotmat")
        pose = person.rotations("pred_rotmat", count, 24)
        betas, transl = person.betas("pred_shape", count), person.get("pred_trans", count, 1, 3)[:, 0]
        track, numbers = file.stem.removeprefix("hps_track_"), _numbers(person, "frame", count)
        fits.append(_track(str(folder), "TRAM", track, betas, pose, transl, numbers, lens))
    return join_fits(fits, str(folder))


def read_prompthmr(content: dict[str, Any], path: str, size: tuple[int, int]) -> SmplFit:
    """results.pkl: camera (img_focal, img_center), and people: id -> frames [N], smplx_cam with pose [N,75] (root, 21 joints, 3 of
    the face), shape [N,10] and trans [N,3] of SMPL-X.

    Pictures were made up to 896 px high; frames are counted from 0.
    """
    camera = Fields(content["camera"], f"camera of {path}", PROMPT_HINT)
    lens, fits = _lens(camera, size), []
    for track, values in content["people"].items():
        person = Fields(values, f"person {track} of {path}", PROMPT_HINT)
        body = Fields(person.take("smplx_cam"), f"smplx_cam of {person.where}", PROMPT_HINT)
        count = body.count("pose")
        pose = body.rotations("pose", count, 25)
        pose = np.concatenate([pose[:, :66], np.zeros((count, 6))], 1)
        betas, transl = body.betas("shape", count), body.get("trans", count, 3)
        numbers = _numbers(person, "frames", count)
        one = _track(path, "PromptHMR", str(track), betas, pose, transl, numbers, lens)
        fits.append(replace(one, pelvis=SMPLX_PELVIS, notes=(OTHER_SHAPE.format("SMPL-X"),)))
    return join_fits(fits, path)


def _lens(camera: Fields, size: tuple[int, int]) -> tuple[float, np.ndarray]:
    """Focal length and center [2] px of this clip, from img_focal and img_center of a video."""
    center = camera.get("img_center", 2)
    ratio = float(same_picture(2 * center[None], size, camera.where, camera.hint)[0])
    return float(_focal(camera.get("img_focal") * ratio, camera.where, camera.hint)), center * ratio


def _track(
    path: str,
    tool: str,
    name: str,
    betas: np.ndarray,
    pose: np.ndarray,
    transl: np.ndarray,
    numbers: np.ndarray,
    lens: tuple[float, np.ndarray],
) -> SmplFit:
    """One person's poses [N,72] with the root, seen by one lens."""
    focal, center = np.full(len(pose), lens[0]), np.tile(lens[1], (len(pose), 1))
    tracks = (name,) * len(pose)
    return SmplFit(
        path, tool, betas, pose[:, :3], pose[:, 3:], transl, numbers=numbers, tracks=tracks, focal=focal, center=center
    )


def _numbers(person: Fields, key: str, count: int) -> np.ndarray:
    numbers = person.get(key, count)
    if (numbers != np.floor(numbers)).any() or (numbers < 0).any():
        worst = int(np.flatnonzero((numbers != np.floor(numbers)) | (numbers < 0))[0])
        facts = [f"row {worst} has {numbers[worst]:g}"]
        raise StageError(f"{key} of {person.where} are not numbers of frames", person.hint, facts)
    return numbers.astype(np.int64)


def _focal(focal: np.ndarray, where: str, hint: str) -> np.ndarray:
    if not (np.asarray(focal) > 0).all():
        raise StageError(f"{where} has a focal length that is not positive", hint, [f"found {np.min(focal):g}"])
    return focal

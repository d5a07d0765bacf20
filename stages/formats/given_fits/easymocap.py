"""Fits of EasyMocap: a .json a frame with everybody in it, X = exp(Rh) SMPL(poses, shapes) + Th in metres.

With one camera, the world of EasyMocap is that camera's frame. Source: EasyMocap easymocap/mytools/file_utils.py,
easymocap/bodymodel/smpl.py.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.given_fits.record import Fields, SmplFit, join_fits

HINT = "give the folder output/smpl of EasyMocap, with 000000.json and so on: id, Rh, Th, poses, shapes"


def read_easymocap(files: list[Path], path: str) -> SmplFit:
    """All frames: lists of people with id, Rh [1,3], Th [1,3], poses [1,72] or [1,69] and shapes [1,10]."""
    return join_fits([fit for file in files for fit in _frame(file, path)], path)


def _frame(file: Path, path: str) -> list[SmplFit]:
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise StageError(f"{file} is not valid JSON", HINT, [str(error)]) from error
    people = content.get("annots") if isinstance(content, dict) else content
    if not isinstance(people, list):
        raise StageError(f"{file} lists no people", HINT, [f"it is a {type(content).__name__}"])
    return [_person(Fields(values, str(file), HINT), file.stem, path) for values in people]


def _person(one: Fields, name: str, path: str) -> SmplFit:
    track = one.take("id")
    if not isinstance(track, int | str):
        raise StageError(f"id in {one.where} names nobody", HINT, [f"it is {track!r}"])
    turns = one.rotations("Rh", 1, 1)
    joints = 24 if one.array("poses").shape[-1] == 72 else 23
    pose = one.rotations("poses", 1, joints)
    pose = np.concatenate([np.zeros((1, 72 - 3 * joints)), pose], 1)
    orient = (Rotation.from_rotvec(turns) * Rotation.from_rotvec(pose[:, :3])).as_rotvec()
    return SmplFit(
        path,
        "EasyMocap",
        betas=one.betas("shapes", 1),
        global_orient=orient,
        body_pose=pose[:, 3:],
        transl=one.get("Th", 1, 3),
        names=(name,),
        tracks=(str(track),),
        turns=turns,
    )

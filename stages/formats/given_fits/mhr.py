"""Fits of SAM 3D Body, whose body is MHR: of everybody in a picture 70 points in the camera, from which the pose follows.

process_one_image gives a list of people; its keys are kept here, however they are saved: a file a picture (.npz, .pkl, .npy), or
one of all: picture's name -> people, a list of people for each frame, or a list of {frame, outputs}.
Sources: sam_3d_body/sam_3d_body_estimator.py, models/heads/mhr_head.py and camera_head.py, metadata/mhr70.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from stages.formats.given_fits.record import Fields, SmplFit, join_fits, same_picture
from stages.formats.given_landmarks.skeletons import SKELETONS, places_of

HINT = "give what process_one_image of SAM 3D Body returned: pred_keypoints_3d [70,3], pred_cam_t [3] and focal_length"
POINTS = "pred_keypoints_3d"
PICTURE = ("frame", "image", "image_name", "image_path", "frame_name")
PEOPLE = ("outputs", "people", "persons")


def is_mhr(content: object) -> bool:
    """Whether content has people of SAM 3D Body."""
    if isinstance(content, Mapping) and POINTS in content:
        return True
    inner = list(
        content.values() if isinstance(content, Mapping) else content if isinstance(content, list | tuple) else ()
    )
    first = next((one for one in inner if isinstance(one, Mapping | list | tuple) and len(one)), None)
    if isinstance(first, Mapping):
        return POINTS in first or any(key in first and is_mhr(list(first[key])) for key in PEOPLE)
    return first is not None and isinstance(first[0], Mapping) and POINTS in first[0]


def read_mhr(content: object, path: str, size: tuple[int, int], name: str = "") -> SmplFit:
    """`points` [N,33,3] m in each camera; `name` is the picture's where the file is of one."""
    fits = []
    for picture, number, values in _people(content, name):
        person = Fields(values, f"a person in {picture or f'frame {number}'} of {path}", HINT)
        points = person.get(POINTS, 70, 3) + person.get("pred_cam_t", 3)
        focal = float(np.ravel(person.get("focal_length", *np.shape(person.array("focal_length"))))[0])
        center, ratio = np.array(size) / 2, 1.0
        if "pred_keypoints_2d" in person:  # the tool's principal point, which is the middle of its picture
            pixels = person.get("pred_keypoints_2d", 70, 2)
            middle = np.median(pixels - focal * points[:, :2] / points[:, 2:], axis=0)
            ratio = float(same_picture(np.round(2 * middle)[None], size, person.where, HINT)[0])
            center = middle * ratio
        places = places_of(SKELETONS["MHR-70"])
        fits.append(
            SmplFit(
                path,
                "SAM 3D Body",
                betas=np.zeros((1, 10)),
                global_orient=np.zeros((1, 3)),
                body_pose=np.zeros((1, 69)),
                transl=np.zeros((1, 3)),
                names=(picture,) if picture else None,
                numbers=None if picture else np.array([number]),
                tracks=("",),
                focal=np.array([focal * ratio]),
                center=center[None],
                points=np.where((places >= 0)[:, None], points[places], np.nan)[None],
                body="MHR",
            )
        )
    return join_fits(fits, path)


def _people(content: Any, name: str) -> Iterator[tuple[str, int, Any]]:
    """(picture's name, or "" and the frame's number, person) of everybody."""
    if isinstance(content, Mapping) and POINTS in content:
        yield name, 0, content
        return
    if not isinstance(content, Mapping) and all(isinstance(one, Mapping) and POINTS in one for one in content) and name:
        yield from ((name, 0, one) for one in content)
        return
    pairs = content.items() if isinstance(content, Mapping) else enumerate(content)
    for number, (key, there) in enumerate(pairs):
        picture = str(key) if isinstance(content, Mapping) else ""
        if isinstance(there, Mapping) and POINTS not in there:
            picture = next((str(there[one]) for one in PICTURE if one in there), picture)
            there = next((there[one] for one in PEOPLE if one in there), ())
        for person in [there] if isinstance(there, Mapping) else there:
            yield picture, number, person

"""landmarks.npz: the 33 landmarks of BlazePose that a person was followed by, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stages.formats.arrays import checked, read_npz, take, write_npz
from stages.records import SeenLandmarks

HINT = "run the masks stage again: `hugs run VIDEO masks --force`"
# fmt: off
NAMES = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
    "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
    "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle",
    "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)
# fmt: on
COUNT = len(NAMES)
MIRRORED = [
    NAMES.index(name.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")) for name in NAMES
]
"""The place of each on the other side of the body."""


def write_landmarks(path: Path, names: Sequence[str], seen: Sequence[SeenLandmarks | None]) -> None:
    """Write what was `seen` of a person in the frames `names`; zeros where nobody was found."""
    blank = np.zeros((COUNT, 6))
    found = np.stack([blank if one is None else np.c_[one.xy, one.visibility, one.world] for one in seen])
    arrays = {"xy": found[..., :2], "visibility": found[..., 2], "world": found[..., 3:]}
    write_npz(path, {"names": np.array(names, dtype=np.str_)} | arrays)


def read_landmarks(path: Path) -> dict[str, SeenLandmarks | None]:
    """What was seen of a person in each frame, None where nobody was found; StageError as for other arrays."""
    arrays = read_npz(path, HINT)
    names = [str(name) for name in take(arrays, "names", path, HINT)]
    shapes = {"xy": (len(names), COUNT, 2), "visibility": (len(names), COUNT), "world": (len(names), COUNT, 3)}
    parts = [checked(take(arrays, key, path, HINT), shape, key, path, HINT) for key, shape in shapes.items()]
    seen = (SeenLandmarks(*part) if part[0].any() else None for part in zip(*parts, strict=True))
    return dict(zip(names, seen, strict=True))

"""COLMAP's text model: the rows of cameras.txt, images.txt and points3D.txt.

Source: https://colmap.github.io/format.html
"""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.given_cameras.record import Lens, checked_lens

HINT = "a COLMAP model is cameras, images and points3D of one run, all .bin or all .txt"


def lens_rows(path: Path) -> dict[int, Lens]:
    """cameras.txt: camera id -> lens; StageError with the line that cannot be read."""
    lenses = {}
    for number, line in _lines(path):
        if not line:
            continue
        wanted = "a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
        try:
            key, model, width, height, *params = line.split()
            values = [float(value) for value in params]
            size = int(key), int(width), int(height)
        except ValueError as error:
            raise _wrong(path, number, line, wanted) from error
        lenses[size[0]] = checked_lens(model, values, *size[1:], f"line {number} of {path}", HINT)
    return lenses


def picture_rows(path: Path) -> Iterator[tuple[int, np.ndarray, int, str]]:
    """images.txt, with or without lines of features: what `picture_rows` of colmap_binary gives, StageError with the line."""
    features = False  # whether the line may be that of the picture before; some programs write none
    for number, line in _lines(path):
        features, may_be = False, features
        if not line or (may_be and is_features(line)):
            continue
        features = True
        try:
            key, *pose, camera, name = line.split(None, 9)
            found = int(key), np.array([float(value) for value in pose]), int(camera), name
        except ValueError as error:
            wanted = "a picture: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise _wrong(path, number, line, wanted) from error
        if found[1].shape != (7,):
            raise _wrong(path, number, line, "a picture: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        yield found


def is_features(line: str) -> bool:
    """Whether a line is x, y and point id of features, and no picture, which ends with its name."""
    parts = line.split()
    try:
        return len(parts) % 3 == 0 and all(map(isfinite, map(float, parts)))
    except ValueError:
        return False


def point_rows(path: Path) -> Iterator[tuple[list[float], list[int]]]:
    """points3D.txt: (x y z r g b error, ids of the pictures that see it) of each point."""
    for number, line in _lines(path):
        if not line:
            continue
        try:
            _, *values = line.split()
            numbers, seen = [float(value) for value in values[:7]], [int(value) for value in values[7::2]]
        except ValueError as error:
            raise _wrong(path, number, line, "a point: POINT3D_ID X Y Z R G B ERROR TRACK") from error
        if len(numbers) < 7:
            raise _wrong(path, number, line, "a point: POINT3D_ID X Y Z R G B ERROR TRACK")
        yield numbers, seen


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise StageError(f"cannot read {path}", HINT, [str(error)]) from error
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield number, line.strip()


def _wrong(path: Path, number: int, line: str, wanted: str) -> StageError:
    return StageError(f"line {number} of {path} is not {wanted}", HINT, [f"it is: {line[:80]}"])

"""transforms.json of NeRF programs: a lens and a pose for each picture.

The pose `transform_matrix` takes the camera to the world with OpenGL's axes (x right, y up, z backward). The lens stands
at the top or in a frame, which wins: fl_x fl_y cx cy w h k1 k2 k3 k4 p1 p2, or the field of view camera_angle_x alone.
nerfstudio's `applied_transform` turned the world after SfM; it is taken back. The scale of the world is arbitrary.

Sources: https://docs.nerf.studio/quickstart/data_conventions.html; instant-ngp, scripts/colmap2nerf.py, which copies
cx and cy from COLMAP, so the first pixel's centre is at (0.5, 0.5); the synthetic scenes of NeRF (camera_angle_x).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.formats.given_cameras.record import GivenCameras, Lens, checked_lens, checked_pose, one_size, without_points

HINT = "transforms.json needs frames with file_path and transform_matrix [4,4], and fl_x, w, h (or camera_angle_x)"
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = "OPENCV_FISHEYE"
SAME_FOCAL = 0.01  # relative difference up to which fl_x and camera_angle_x say the same
HUGE = 1e9  # px and coefficients beyond are not those of a lens
OPENGL = np.diag([1.0, -1, -1, 1])  # OpenCV's camera axes in OpenGL's


def read_transforms(path: Path, width: int, height: int) -> GivenCameras:
    """Read transforms.json; `width` and `height` are the clip's, for files that give a field of view and no size.

    Raises StageError with the frame and the key that is missing, has the wrong shape or is no number.
    """
    try:
        top = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise StageError(f"{path} is not JSON", HINT, [str(error)]) from error
    frames = top.get("frames") if isinstance(top, dict) else None
    if not isinstance(frames, list) or not frames:
        found = ", ".join(list(top)[:12]) or "nothing" if isinstance(top, dict) else f"a {type(top).__name__}"
        raise StageError(f"{path} has no frames", HINT, [f"it holds {found}"])
    undo = _undo(top.get("applied_transform"), path)
    files, viewmats, lenses = [], [], []
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            found = ", ".join(list(frame)[:12]) if isinstance(frame, dict) else f"a {type(frame).__name__}"
            raise StageError(f"frame {i} of {path} has no file_path", HINT, [f"it holds {found}"])
        what = f"{frame['file_path']} in {path}"
        pose = checked_pose(_matrix(frame.get("transform_matrix"), "transform_matrix", what), what, HINT)
        files.append(frame["file_path"])
        viewmats.append(np.linalg.inv(undo @ pose @ OPENGL))
        lenses.append(_lens({**top, **frame}, what, width, height))
    one_size(lenses, path)
    return without_points("transforms.json", files, viewmats, lenses)


def _matrix(value: Any, key: str, what: str) -> np.ndarray:
    """A matrix [4,4] from rows of numbers; the last row may be left out."""
    if value is None:
        raise StageError(f"{what} has no {key}", HINT, ["wanted 4x4 numbers"])
    try:
        matrix = np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise StageError(f"{key} of {what} does not hold numbers", HINT, [str(error)]) from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4):
        found = "x".join(map(str, matrix.shape)) or "a single number"
        raise StageError(f"{key} of {what} has the wrong shape", HINT, [f"found {found}, wanted 4x4"])
    return matrix


def _undo(applied: Any, path: Path) -> np.ndarray:
    """The inverse of nerfstudio's applied_transform, 1 without one."""
    if applied is None:
        return np.eye(4)
    what = f"applied_transform in {path}"
    return np.linalg.inv(checked_pose(_matrix(applied, "applied_transform", str(path)), what, HINT))


def _lens(given: dict[str, Any], what: str, width: int, height: int) -> Lens:
    """The lens of one frame, from its own keys and those at the top."""

    def number(key: str) -> float | None:
        value = given.get(key)
        if value is not None and (
            isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < HUGE
        ):
            raise StageError(f"{key} of {what} is not a number", HINT, [f"it is {str(value)[:60]!r}"])
        return value

    def number_or(key: str, default: float) -> float:
        value = number(key)
        return default if value is None else value

    w, h, fx, angle = number("w"), number("h"), number("fl_x"), number("camera_angle_x")
    if fx is None and angle is None:
        raise StageError(f"{what} has neither fl_x nor camera_angle_x", HINT, [f"it holds {', '.join(given)}"])
    if fx is not None and (w is None or h is None):
        fact = f"fl_x is {fx:g}; w and h of the picture it counts in are missing"
        raise StageError(f"{what} has a focal length but no picture size", HINT, [fact])
    w, h = width if w is None else w, height if h is None else h
    if not (w > 0 and h > 0):
        raise StageError(f"{what} has no picture size", HINT, [f"found {w:g}x{h:g}"])
    if angle is not None:
        if not 0 < angle < np.pi:
            raise StageError(
                f"camera_angle_x of {what} is not a field of view", HINT, [f"{angle:g}, wanted 0 to 3.14 rad"]
            )
        wide = 0.5 * w / np.tan(0.5 * angle)
        if fx is not None and abs(fx / wide - 1) > SAME_FOCAL and not given.get("is_fisheye"):
            facts = [f"fl_x is {fx:g} px, camera_angle_x gives {wide:g} px for a width of {w:g}"]
            raise StageError(f"the focal length of {what} belongs to a picture of another size", HINT, facts)
        fx = wide if fx is None else fx
    tall = number("camera_angle_y") if number("fl_x") is None else None
    assert fx is not None  # given, or from the angle
    fy = number_or("fl_y", 0.5 * h / np.tan(0.5 * tall) if tall else fx)
    base = [fx, fy, number_or("cx", 0.5 * w), number_or("cy", 0.5 * h)]
    model, bent = _distortion(given, number_or, what)
    return checked_lens(model, base + bent, round(w), round(h), what, HINT)


def _distortion(given: dict[str, Any], number: Callable[[str, float], float], what: str) -> tuple[str, list[float]]:
    """COLMAP's name of the lens model, and its numbers after the principal point."""
    model = given.get("camera_model", FISHEYE if given.get("is_fisheye") else "OPENCV")
    if model not in (*PERSPECTIVE, FISHEYE):
        facts = [f"it is {str(model)[:60]}, known are {', '.join((*PERSPECTIVE, FISHEYE))}"]
        raise StageError(f"the camera model of {what} is not supported", HINT, facts)
    k1, k2, k3, k4, p1, p2 = (number(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == FISHEYE:
        return FISHEYE, [k1, k2, k3, k4]
    if k4:
        fact = f"k4 is {k4:g}; perspective lenses have k1 k2 k3 p1 p2"
        raise StageError(f"the distortion of {what} has no meaning for a perspective lens", HINT, [fact])
    if k3:
        return "FULL_OPENCV", [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    return ("OPENCV", [k1, k2, p1, p2]) if any((k1, k2, p1, p2)) else ("PINHOLE", [])

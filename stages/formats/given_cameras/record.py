"""The record that every reader of given cameras returns, COLMAP's lens models, and the checks that readers share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from stages.contract import StageError

PARAMS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
}
"""COLMAP's lens models in the order of their numbers in binary files. Source: COLMAP, src/colmap/sensor/models.h."""
FOCAL_RANGE = (0.1, 20.0)
"""Of the longer side; a focal length outside belongs to a picture of another size."""
MIDDLE = (0.1, 0.9)
"""Share of the picture in which the lens's axis must meet it; outside, the numbers are those of another size."""
NOT_TURNED = 1e-3
"""Largest entry of R R^T - 1 up to which R is a rotation that was written with few digits."""


@dataclass(frozen=True)
class Lens:
    """One of COLMAP's lens models for pictures of `width` x `height`; first pixel centre at (0.5, 0.5)."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int

    @cached_property
    def named(self) -> dict[str, float]:
        """Parameter name -> value, with `f` given as `fx` and `fy`."""
        found = dict(zip(PARAMS[self.model].split(), self.params, strict=True))
        return found | dict.fromkeys(("fx", "fy"), found["f"]) if "f" in found else found

    @property
    def K(self) -> np.ndarray:
        """[3,3] px, the lens without its distortion."""
        n = self.named
        return np.array([[n["fx"], 0, n["cx"]], [0, n["fy"], n["cy"]], [0, 0, 1.0]])

    @property
    def distortion(self) -> np.ndarray:
        """What follows focal length and principal point."""
        return np.array(self.params[(3 if "f" in PARAMS[self.model].split() else 4) :])


@dataclass(frozen=True)
class GivenCameras:
    """C pictures with their cameras, and P points, in the program's own world and units.

    `files` [C] names as written; `viewmats` [C,4,4] camera_from_world, OpenCV axes; `lenses` [C]; `points` [P,3],
    `colors` [P,3] uint8, `errors` [P] px, `tracks` the rows of C that see each point. P may be 0.
    """

    source: str
    files: tuple[str, ...]
    viewmats: np.ndarray
    lenses: tuple[Lens, ...]
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    tracks: tuple[np.ndarray, ...]

    def __len__(self) -> int:
        return len(self.files)

    def median_triangulation_deg(self) -> float | None:
        """Median over the points of the largest angle between two rays to them, None without points."""
        centers = -(self.viewmats[:, :3, :3].mT @ self.viewmats[:, :3, 3:])[..., 0]
        angles = widest_angles(self.points, self.tracks, centers)
        return float(np.median(angles)) if len(angles) else None


def without_points(
    source: str, files: Sequence[str], viewmats: Sequence[np.ndarray], lenses: Sequence[Lens]
) -> GivenCameras:
    """Cameras from a file that has no points."""
    nothing = np.zeros((0, 3))
    return GivenCameras(
        source, tuple(files), np.stack(viewmats), tuple(lenses), nothing, nothing.astype(np.uint8), np.zeros(0), ()
    )


def possible_errors(errors: np.ndarray, width: int, height: int) -> np.ndarray:
    """Those reprojection errors [P] px that are known, the picture's diagonal at most.

    COLMAP writes -1 for an error that nobody computed, and 1e154 px for a point behind a camera.
    """
    return errors[errors >= 0].clip(max=math.hypot(width, height))


RAYS = 512  # of a point, at most: each is compared with each


def widest_angles(points: np.ndarray, tracks: Sequence[np.ndarray], centers: np.ndarray) -> np.ndarray:
    """The widest angle in degrees [P] at which cameras at `centers` [C,3] see each of `points` [P,3]."""
    widest = []
    for point, track in zip(points, tracks, strict=True):
        seen = np.unique(track)
        rays = centers[seen[:: len(seen) // RAYS + 1]] - point
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)  # a point may lie in a camera
        chords = np.linalg.norm(rays[:, None] - rays[None], axis=-1)
        widest.append(np.degrees(2 * np.arcsin(np.clip(chords.max(initial=0) / 2, 0, 1))))
    return np.array(widest)


def checked_lens(model: str, params: Sequence[float], width: int, height: int, what: str, hint: str) -> Lens:
    """The lens if its numbers can belong to a picture of that size, else StageError; `what` names it."""
    if model not in PARAMS:
        facts = [f"it is {model}, known are {', '.join(PARAMS)}"]
        raise StageError(f"the camera model of {what} is not supported", hint, facts)
    wanted = PARAMS[model].split()
    if len(params) != len(wanted):
        facts = [f"found {len(params)} numbers, {model} has {len(wanted)}: {' '.join(wanted)}"]
        raise StageError(f"the numbers of {what} are not those of its camera model", hint, facts)
    if not np.isfinite(params).all():
        found = ", ".join(f"{name} = {value:g}" for name, value in zip(wanted, params, strict=True))
        raise StageError(f"{what} has numbers that are not finite", hint, [found])
    if not (0 < width <= 1 << 16 and 0 < height <= 1 << 16):
        raise StageError(f"{what} has no picture size", hint, [f"found {width}x{height}"])
    lens = Lens(model, tuple(float(value) for value in params), width, height)
    side, K = max(width, height), lens.K
    low, high = (share * side for share in FOCAL_RANGE)
    if not all(low <= K[i, i] <= high for i in (0, 1)):
        facts = [f"focal length {K[0, 0]:g}, {K[1, 1]:g} px; the picture is {width}x{height}"]
        raise StageError(f"{what} has no usable focal length for its picture's size", hint, facts)
    if not all(MIDDLE[0] <= K[i, 2] / size <= MIDDLE[1] for i, size in enumerate((width, height))):
        facts = [f"principal point ({K[0, 2]:g}, {K[1, 2]:g}) px; the picture is {width}x{height}"]
        raise StageError(f"the numbers of {what} belong to a picture of another size", hint, facts)
    return lens


def checked_pose(matrix: np.ndarray, what: str, hint: str) -> np.ndarray:
    """A pose [4,4] with its rotation made exact; StageError for one that is not finite, mirrored or no rotation."""
    if not np.isfinite(matrix).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(matrix))[0])
        fact = f"the first stands in row {row}, column {column}: {matrix[row, column]}"
        raise StageError(f"the pose of {what} has numbers that are not finite", hint, [fact])
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > NOT_TURNED:
        fact = f"its last row is {' '.join(f'{value:g}' for value in matrix[3])}, wanted 0 0 0 1"
        raise StageError(f"the pose of {what} is not a rotation and a translation", hint, [fact])
    R = matrix[:3, :3]
    off, determinant = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.det(R)
    if off > NOT_TURNED:
        fact = f"R R^T is off by {off:.3g}, the determinant of R is {determinant:.3g}"
        raise StageError(f"the pose of {what} is not a rotation and a translation", hint, [fact])
    if determinant < 0:
        fact = f"the determinant of its rotation is {determinant:.3g}, wanted 1"
        raise StageError(f"the pose of {what} is mirrored", hint, [fact])
    u, _, vt = np.linalg.svd(R)
    exact = np.array(matrix, np.float64)
    exact[:3, :3], exact[3] = u @ vt, [0, 0, 0, 1]
    return exact


def one_size(lenses: Sequence[Lens], path: Path) -> tuple[int, int]:
    """Width and height that all pictures share; StageError if they differ."""
    sizes = sorted({(lens.width, lens.height) for lens in lenses})
    if len(sizes) > 1:
        facts = [", ".join(f"{width}x{height}" for width, height in sizes)]
        raise StageError(f"the cameras in {path} have different sizes", "give pictures of one camera", facts)
    return sizes[0]

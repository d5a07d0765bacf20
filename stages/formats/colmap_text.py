"""COLMAP's text model: cameras.txt, images.txt and points3D.txt of a folder."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.contract import StageError

PARAMS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
}
"""Models that OpenCV's five distortion numbers can hold."""
LENS = ("k1", "k2", "p1", "p2", "k3")
HINT = "sparse/ must be COLMAP's text model: cameras.txt, images.txt and points3D.txt of one run"


@dataclass(frozen=True)
class TextModel:
    """C registered pictures in the order of their file names, and P points, in SfM units.

    `files` [C]; `viewmats` [C,4,4] camera_from_world; `Ks` [C,3,3] px, first pixel centre at (0.5, 0.5); `lenses` [C,5]
    k1 k2 p1 p2 k3; `points` [P,3], `colors` [P,3] uint8, `errors` [P] px, `tracks` the rows of C that see each point.
    """

    files: tuple[str, ...]
    viewmats: np.ndarray
    Ks: np.ndarray
    lenses: np.ndarray
    width: int
    height: int
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    tracks: tuple[np.ndarray, ...]

    def median_triangulation_deg(self) -> float | None:
        """Median over the points of the largest angle between two rays to them, None without points."""
        centres = -(self.viewmats[:, :3, :3].mT @ self.viewmats[:, :3, 3:])[..., 0]
        widest = []
        for point, track in zip(self.points, self.tracks, strict=True):
            rays = point - centres[track]
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            widest.append(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min())) if len(rays) else 0.0)
        return float(np.median(widest)) if widest else None


def read_text_model(folder: Path) -> TextModel:
    """Read the three files; StageError with file and line for what cannot be read, and for pictures of several sizes."""
    cameras = dict(_cameras(folder / "cameras.txt"))
    images = sorted(_images(folder / "images.txt"), key=lambda image: image[1])
    if not images:
        raise StageError(f"no picture has a camera in {folder / 'images.txt'}", HINT)
    lost = sorted({image[3] for image in images} - cameras.keys())
    if lost:
        raise StageError(f"cameras.txt in {folder} lacks cameras that images.txt names", HINT, [f"first: {lost[0]}"])
    used = [cameras[image[3]] for image in images]
    sizes = sorted({camera[0] for camera in used})
    if len(sizes) > 1:
        facts = [", ".join(f"{width}x{height}" for width, height in sizes)]
        raise StageError(f"the cameras in {folder} have different sizes", "give pictures of one camera", facts)
    row = {image[0]: i for i, image in enumerate(images)}
    points = list(_points(folder / "points3D.txt", row))
    values = np.array([point[0] for point in points], np.float64).reshape(-1, 7)
    return TextModel(
        files=tuple(image[1] for image in images),
        viewmats=np.stack([image[2] for image in images]),
        Ks=np.stack([camera[1] for camera in used]),
        lenses=np.stack([camera[2] for camera in used]),
        width=sizes[0][0],
        height=sizes[0][1],
        points=values[:, :3],
        colors=values[:, 3:6].astype(np.uint8),
        errors=values[:, 6],
        tracks=tuple(point[1] for point in points),
    )


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise StageError(f"cannot read {path}", HINT, [str(error)]) from error
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield number, line.strip()


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def _wrong(path: Path, number: int, line: str, wanted: str) -> StageError:
    return StageError(f"line {number} of {path} is not {wanted}", HINT, [f"it is: {line[:80]}"])


def _cameras(path: Path) -> Iterator[tuple[int, tuple[tuple[int, int], np.ndarray, np.ndarray]]]:
    for number, line in _lines(path):
        if not line:
            continue
        wanted = "a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
        try:
            key, model, width, height, *params = line.split()
            values = [_finite(value) for value in params]
            size = int(key), int(width), int(height)
        except ValueError as error:
            raise _wrong(path, number, line, wanted) from error
        if model not in PARAMS:
            facts = [f"it is {model}, known are {', '.join(PARAMS)}"]
            raise StageError(f"the camera model in line {number} of {path} is not supported", HINT, facts)
        if len(values) != len(PARAMS[model].split()):
            raise _wrong(path, number, line, f"{wanted} with {len(PARAMS[model].split())} numbers for {model}")
        named = dict(zip(PARAMS[model].split(), values))
        K = np.array([[named.get("fx", named.get("f")), 0, named["cx"]], [0, named.get("fy", named.get("f")), named["cy"]],
                      [0, 0, 1.0]])  # fmt: skip
        yield size[0], (size[1:], K, np.array([named.get(name, 0.0) for name in LENS]))


def _images(path: Path) -> Iterator[tuple[int, str, np.ndarray, int]]:
    """(image id, file name, viewmat [4,4], camera id) of each picture; the line after it lists its features."""
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            key, *pose, camera, name = line.split(None, 9)
            w, x, y, z, *t = (_finite(value) for value in pose)
            if len(t) != 3:
                raise ValueError(f"{len(pose)} numbers of 7")
            norm, ids = math.hypot(w, x, y, z), (int(key), int(camera))
            w, x, y, z = w / norm, x / norm, y / norm, z / norm
        except (ValueError, ZeroDivisionError) as error:
            wanted = "a picture: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise _wrong(path, number, line, wanted) from error
        viewmat = np.eye(4)
        viewmat[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        viewmat[:3, 3] = t
        next(lines, None)
        yield ids[0], name, viewmat, ids[1]


def _points(path: Path, row: dict[int, int]) -> Iterator[tuple[list[float], np.ndarray]]:
    """(x y z r g b error, the rows of the pictures that see it) of each point."""
    for number, line in _lines(path):
        if not line:
            continue
        try:
            _, *values = line.split()
            numbers, seen = [_finite(value) for value in values[:7]], [int(value) for value in values[7::2]]
        except ValueError as error:
            raise _wrong(path, number, line, "a point: POINT3D_ID X Y Z R G B ERROR TRACK") from error
        if len(numbers) < 7:
            raise _wrong(path, number, line, "a point: POINT3D_ID X Y Z R G B ERROR TRACK")
        yield numbers, np.array([row[i] for i in dict.fromkeys(seen) if i in row], np.int64)

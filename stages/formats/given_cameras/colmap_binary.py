"""COLMAP's binary model: the rows of cameras.bin, images.bin and points3D.bin, little-endian and without padding.

Source: COLMAP, src/colmap/scene/reconstruction_io_binary.cc. Rigs and frames of newer models stand in files of their
own; images.bin keeps each picture's pose. pycolmap never stops reading a file that was cut short, so it is not used.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.given_cameras.colmap_text import HINT
from stages.formats.given_cameras.record import PARAMS, Lens, checked_lens

FEATURE_BYTES = 24  # x, y, point id


class Bytes:
    """A file read from its start; StageError with the place where it ends too soon."""

    def __init__(self, path: Path):
        self.path, self.at = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise StageError(f"cannot read {path}", HINT, [str(error)]) from error

    def take(self, layout: str) -> tuple:
        """The next values of this struct layout."""
        start = self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def skip(self, count: int) -> int:
        """Skip `count` bytes; returns their start."""
        if count > len(self.data) - self.at:
            facts = [f"{count} bytes are wanted from byte {self.at} on, the file has {len(self.data)}"]
            raise StageError(f"{self.path} is cut short or not a COLMAP file", HINT, facts)
        self.at += count
        return self.at - count

    def text(self) -> str:
        """Text up to a zero byte."""
        end = self.data.find(b"\0", self.at)
        start = self.skip((end if end >= 0 else len(self.data)) - self.at + 1)
        try:
            return self.data[start : self.at - 1].decode()
        except UnicodeDecodeError as error:
            fact = f"from byte {start} on: {self.data[start : start + 40]!r}"
            raise StageError(f"{self.path} has a picture name that is not text", HINT, [fact]) from error

    def rows(self) -> Iterator[int]:
        """The row numbers below the count that is read next; StageError if bytes are left after the last."""
        (count,) = self.take("Q")
        yield from range(count)
        if self.at != len(self.data):
            fact = f"{len(self.data) - self.at} bytes follow the {count} rows of its header"
            raise StageError(f"{self.path} is not a COLMAP file", HINT, [fact])


def lens_rows(path: Path) -> dict[int, Lens]:
    """cameras.bin: camera id -> lens."""
    file, lenses = Bytes(path), {}
    for _ in file.rows():
        key, number, width, height = file.take("IiQQ")
        what = f"camera {key} of {path}"
        if not 0 <= number < len(PARAMS):
            facts = [f"it is number {number}, known are {', '.join(f'{i} {name}' for i, name in enumerate(PARAMS))}"]
            raise StageError(f"the camera model of {what} is not supported", HINT, facts)
        model = list(PARAMS)[number]
        params = file.take(f"{len(PARAMS[model].split())}d")
        lenses[key] = checked_lens(model, params, width, height, what, HINT)
    return lenses


def picture_rows(path: Path) -> Iterator[tuple[int, np.ndarray, int, str]]:
    """images.bin: (image id, quaternion w x y z and translation [7], camera id, file name) of each picture."""
    file = Bytes(path)
    for _ in file.rows():
        key, *pose, camera = file.take("I7dI")
        name, (features,) = file.text(), file.take("Q")
        file.skip(features * FEATURE_BYTES)
        yield key, np.array(pose), camera, name


def point_rows(path: Path) -> Iterator[tuple[list[float], list[int]]]:
    """points3D.bin: (x y z r g b error, ids of the pictures that see it) of each point."""
    file = Bytes(path)
    for _ in file.rows():
        _, *numbers, length = file.take("Q3d3BdQ")
        start = file.skip(8 * length)
        seen = np.frombuffer(file.data, "<u4", 2 * length, start)[::2]
        yield numbers, seen.tolist()

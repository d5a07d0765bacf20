"""Landmarks of other programs: recognizes the container by name and content."""

from __future__ import annotations

from pathlib import Path

from stages.contract import StageError
from stages.formats.given_landmarks.arrays import read_arrays
from stages.formats.given_landmarks.json_files import read_json, read_json_folder
from stages.formats.given_landmarks.record import HINT, GivenLandmarks, in_pixels
from stages.formats.given_landmarks.tables import read_csv, read_trc
from stages.formats.kinds import kind_of, names_in

READERS = {".json": read_json, ".csv": read_csv, ".trc": read_trc, ".npz": read_arrays, ".npy": read_arrays}


def read_landmark_file(path: Path, size: tuple[int, int]) -> GivenLandmarks:
    """Landmarks of a clip whose film has pictures of `size` (width, height) px; StageError for what holds none."""
    path = Path(path)
    if not path.exists():
        raise StageError(f"no file {path}", HINT)
    if path.is_dir():
        if any(path.glob("*.json")):
            return in_pixels(read_json_folder(path), size)
        inner = sorted(one for one in path.iterdir() if one.suffix.lower() in READERS or one.is_dir())
        if len(inner) == 1:
            return read_landmark_file(inner[0], size)
        raise StageError(f"{path} holds no landmarks", HINT, [f"found {names_in(path)}"])
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        kind = kind_of(path)
        raise StageError(f"{path} holds no landmarks", HINT, [f"it is {kind or 'of no known kind'}"])
    return in_pixels(reader(path), size)

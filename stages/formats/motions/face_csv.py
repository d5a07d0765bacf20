"""Face captures: a CSV with a row a frame, a column for each of the 52 shapes, and times, as face capture apps write it.

Columns are known by name, whatever their case: EyeBlinkLeft or eyeBlinkLeft; others, such as the head's turns, are left out. Times
stand in seconds (time, timestamp, seconds; time_ms, timestamp_ms in thousandths) or as a time code, hours:minutes:seconds:frames.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.budget import check_count
from stages.formats.motions.bvh import text_of
from stages.gestures import FACE_NAMES

HINT = "give a CSV with a header: a time, and the 52 shapes by name (jawOpen, eyeBlinkLeft, ...), 0 to 1"
TIMES = {"time": 1.0, "timestamp": 1.0, "seconds": 1.0, "time_ms": 1e-3, "timestamp_ms": 1e-3, "timecode": 1.0}
RATES = (24, 25, 30, 48, 50, 60, 100, 120)  # frames a second of time codes
DEFAULT_FPS = 60.0  # of rows without times
PERCENT = 5.0  # no shape goes so far: a column that does holds no coefficients of 0 to 1
_CODE = re.compile(r"(\d+):(\d+):(\d+)[:;](\d+(?:\.\d+)?)$")


@dataclass(frozen=True)
class FaceTake:
    """R rows: rising `times` [R] s from 0, coefficients `face` [R,52] as FACE_NAMES; `notes` on what of the file was taken how."""

    times: np.ndarray
    face: np.ndarray
    notes: tuple[str, ...]


def read_face(path: Path) -> FaceTake:
    """Read a face capture; StageError with the row and the column of what cannot be read, and for a file without shapes."""
    try:
        rows = [row for row in csv.reader(io.StringIO(text_of(Path(path).read_bytes()))) if any(map(str.strip, row))]
    except FileNotFoundError as error:
        raise StageError(f"no file {path}", HINT) from error
    except (ValueError, csv.Error) as error:
        raise StageError(f"{path} is no CSV", HINT, [str(error)]) from error
    header = [name.strip().lower() for name in rows[0]] if rows else []
    columns = {name: header.index(name.lower()) for name in FACE_NAMES if name.lower() in header}
    if not columns or len(rows) < 2:
        facts = [
            f"its columns are {', '.join(header[:12]) or 'none'}",
            f"it has {max(0, len(rows) - 1)} rows below them",
        ]
        raise StageError(f"{path} holds no face capture", HINT, facts)
    check_count(len(rows), "poses", path, "cut the capture")
    face = np.zeros((len(rows) - 1, len(FACE_NAMES)))
    for name, column in columns.items():
        face[:, FACE_NAMES.index(name)] = [
            _number(row, column, name, i, path) for i, row in enumerate(rows[1:], start=2)
        ]
    if face.max() > PERCENT:
        row, shape = np.unravel_index(face.argmax(), face.shape)
        facts = [f"{FACE_NAMES[shape]} is {face[row, shape]:g} in row {row + 2}"]
        raise StageError(f"{path} does not hold coefficients of 0 to 1", HINT, facts)
    notes = [f"{len(columns)} of {len(FACE_NAMES)} shapes of the face"]
    if beyond := int(((face < 0) | (face > 1)).sum()):
        notes.append(f"{beyond} coefficients beyond 0 to 1 are held there")
    times, said = _times(header, rows[1:], path)
    return FaceTake(times, face.clip(0, 1), (*notes, *said))


def _number(row: list[str], column: int, name: str, line: int, path: Path) -> float:
    try:
        value = float(row[column])
    except (IndexError, ValueError) as error:
        raise StageError(f"row {line} of {path} has no number for {name}", HINT, [str(error)]) from error
    if not np.isfinite(value):
        raise StageError(f"row {line} of {path} has a {name} that is not finite", HINT, [row[column]])
    return value


def _times(header: list[str], rows: list[list[str]], path: Path) -> tuple[np.ndarray, list[str]]:
    """Seconds [R] of the rows, and what is to be said of them."""
    key = next((name for name in TIMES if name in header), None)
    if key is None:
        return np.arange(len(rows)) / DEFAULT_FPS, [f"no times in it: {DEFAULT_FPS:g} rows a second taken"]
    column, said = header.index(key), []
    codes = [_CODE.match(row[column].strip()) if column < len(row) else None for row in rows]
    if all(codes):
        parts = np.array([[float(part) for part in code.groups()] for code in codes if code])
        rate = next((rate for rate in RATES if rate > parts[:, 3].max()), RATES[-1])
        times = parts[:, :3] @ [3600, 60, 1] + parts[:, 3] / rate
        said.append(f"time codes of {rate} frames a second")
    else:
        seconds = [_number(row, column, key, i, path) for i, row in enumerate(rows, start=2)]
        times = np.array(seconds) * TIMES[key]
    if (back := np.flatnonzero(np.diff(times) <= 0)).size:
        facts = [f"row {back[0] + 3} is at {times[back[0] + 1]:.3f} s, the one before at {times[back[0]]:.3f} s"]
        raise StageError(f"the times of {path} do not rise", HINT, facts)
    return times - times[0], said

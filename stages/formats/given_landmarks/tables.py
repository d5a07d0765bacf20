"""Landmarks in tables: .csv as DeepLabCut writes it, .trc as Pose2Sim, Sports2D and OpenSim do.

DeepLabCut: rows of names before the numbers (scorer, individuals, bodyparts, coords), a column of frames, then x, y (z) and
likelihood of each point. TRC: two lines of facts, names of the markers, then frame, time and X Y Z of each; without depth,
X and Y are px. Sources: DeepLabCut deeplabcut/utils/auxiliaryfunctions.py, Pose2Sim Pose2Sim/common.py.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.frame_names import stem
from stages.formats.given_landmarks.record import HINT, GivenLandmarks, Row, of_rows

AXES, SURE = ("x", "y", "z"), ("likelihood", "confidence", "score", "visibility", "p")
TIME = ("time", "seconds", "timestamp")
IN_PIXELS = 10.0  # more than any place of a marker in m


def read_csv(path: Path) -> GivenLandmarks:
    """The table of one person or, with `individuals` in its head, of several; StageError without x and y of named points."""
    lines = [line for line in csv.reader(_text(path).splitlines()) if any(cell.strip() for cell in line)]
    head = [line for line in lines[:6] if not _is_number(line[-1])]
    body = lines[len(head) :]
    if not head or not body:
        raise StageError(
            f"{path} is no table of landmarks", HINT, [f"{len(head)} lines of names, {len(body)} of numbers"]
        )
    named = {line[0].strip().lower(): line[1:] for line in head}
    if "coords" in named:
        parts, coords = named["bodyparts"], named["coords"]
        people = named.get("individuals", [""] * len(parts))
    else:  # one line: left_hip_x, left_hip_y, left_hip_likelihood
        cut = [cell.strip().rpartition("_") for cell in head[-1][1:]]
        parts, coords, people = [a for a, _, _ in cut], [b for _, _, b in cut], [""] * len(cut)
    table = np.array([[_value(cell) for cell in line[1:]] + [np.nan] * (len(coords) - len(line) + 1) for line in body])
    first, start = [line[0].strip() for line in body], head[-1][0].strip().lower()
    times = np.array([_value(cell) for cell in first]) if start in TIME else None
    places: dict[str, dict[tuple[str, str], int]] = {who: {} for who in people}
    for k, (part, coord, who) in enumerate(zip(parts, coords, people)):
        places[who][part, coord.strip().lower()] = k
    named_by = [[part for part, axis in at if axis == AXES[0] and (part, AXES[1]) in at] for at in places.values()]
    names = max(named_by, key=len, default=[])
    rows, few = [], []
    for who, at in places.items():
        if any((name, axis) not in at for name in names for axis in AXES[:2]):
            few.append(who.strip())
            continue
        xyz = np.stack([table[:, [at[name, axis] for name in names]] for axis in AXES if (names[0], axis) in at], -1)
        sure = next((key for key in SURE if (names[0], key) in at), None)
        trust = None if sure is None else table[:, [at[name, sure] for name in names]]
        for i, label in enumerate(first):
            number = int(float(label)) if _is_number(label) else None
            rows.append(
                Row(
                    xyz[i] if xyz.shape[2] == 2 else None,
                    None if trust is None else trust[i],
                    xyz[i] if xyz.shape[2] == 3 else None,
                    name=stem(label) if number is None and times is None else None,
                    number=number if times is None else None,
                    track=who.strip() or None,
                )
            )
    notes = [f"{', '.join(few)} of {path.name} have not all points: left out"] if few else []
    return of_rows(str(path), "table", rows, names, times, notes)


def read_trc(path: Path) -> GivenLandmarks:
    """The markers of one person; StageError for a flat table in m, which says neither pixels nor depth."""
    lines = [line.split("\t") for line in _text(path).splitlines()]
    start = next((i for i, line in enumerate(lines) if line[0].strip().lower() in ("frame#", "frame")), None)
    if start is None:
        raise StageError(f"{path} is no .trc file", HINT, ["no line begins with Frame#"])
    names = tuple(cell.strip() for cell in lines[start][2:] if cell.strip())
    body = [line for line in lines[start + 1 :] if _is_number(line[0])]
    wide = 2 + 3 * len(names)
    table = np.array([[_value(cell) for cell in line[:wide]] + [np.nan] * (wide - len(line)) for line in body])
    if not len(table):
        raise StageError(f"{path} holds no landmarks", HINT, [f"{len(names)} markers, no frame"])
    markers = table[:, 2:].reshape(len(table), -1, 3)
    flat = not np.nan_to_num(markers[..., 2]).any()
    if flat and not np.nanmax(np.abs(markers), initial=0.0) > IN_PIXELS:
        raise StageError(f"{path} is flat and in metres", "give the one in pixels, or one with depth")
    rows = [Row(one[:, :2] if flat else None, None, None if flat else one) for one in markers]
    return of_rows(str(path), "TRC", rows, names, table[:, 1])


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise StageError(f"cannot read {path}", HINT, [str(error)]) from error


def _is_number(cell: str) -> bool:
    return np.isfinite(_value(cell)) or cell.strip().lower() == "nan"


def _value(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")

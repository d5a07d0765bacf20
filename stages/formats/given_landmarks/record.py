"""The record that every reader of landmarks returns, made of the rows that a file holds: one person in one picture each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any, ClassVar

import numpy as np

from stages.contract import StageError
from stages.formats.given_landmarks.skeletons import recognise

HINT = (
    "`--landmarks` takes keypoints as OpenPose, MMPose, AlphaPose, ViTPose or Sapiens write them (.json, or a folder of them), "
    "a .csv as of DeepLabCut, a .trc, or a .npz or .npy of [frames, points, 2 or 3]"
)
SCALES = ((1.5, 1.0), (10.0, 0.0), (101.0, 100.0), (256.0, 255.0))
"""Largest confidence in a file -> what is 1; 0: that largest one."""
SHARE = (1.0, 99.0)  # percent: what lies beyond is not looked at when ranges are
NORMALISED = 1.5  # no picture is so few px wide


@dataclass(frozen=True)
class GivenLandmarks:
    """N rows of BlazePose's 33 points, NaN where a point is not known.

    `xy` [N,33,2] px of the film's pictures, or None; `confidence` [N,33] 0..1; `world`
    [N,33,3] with any axes and unit, or None. Rows belong to frames by `names`, `numbers` or `times` [N] s as those of fits do;
    `tracks` tell people apart. `skeleton` is whose points they are, `notes` what was corrected.
    """

    path: str
    tool: str
    skeleton: str
    xy: np.ndarray | None
    confidence: np.ndarray
    world: np.ndarray | None = None
    names: tuple[str, ...] | None = None
    numbers: np.ndarray | None = None
    times: np.ndarray | None = None
    tracks: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()
    what: ClassVar[str] = "landmarks"

    def __len__(self) -> int:
        return len(self.confidence)

    def rows(self, chosen: Sequence[int]) -> GivenLandmarks:
        """The same with these rows alone."""
        taken: dict[str, Any] = {}
        for key in ("xy", "confidence", "world", "numbers", "times", "names", "tracks"):
            if (value := getattr(self, key)) is not None:
                taken[key] = value[list(chosen)] if isinstance(value, np.ndarray) else tuple(value[i] for i in chosen)
        return replace(self, **taken)


@dataclass(frozen=True)
class Row:
    """One person in one picture: `points` [K,2], `depths` [K,3] or both, `confidence` [K]; the picture by name or number."""

    points: np.ndarray | None
    confidence: np.ndarray | None = None
    depths: np.ndarray | None = None
    name: str | None = None
    number: int | None = None
    track: str | None = None


def of_rows(
    path: str,
    tool: str,
    rows: Sequence[Row],
    names: Sequence[str] | None = None,
    times: np.ndarray | None = None,
    notes: Sequence[str] = (),
) -> GivenLandmarks:
    """The record of the `rows` of a file, whose points have `names` or an order; `notes` are what its reader left out.
    StageError where there are no rows."""
    if not rows:
        raise StageError(f"{path} holds no landmarks", "let the network run again: it found nobody")
    xy, world, given = (
        _stacked([getattr(one, key) for one in rows], path) for key in ("points", "depths", "confidence")
    )
    seen = xy if xy is not None else world
    if seen is None:
        raise StageError(f"{path} holds no landmarks", HINT, ["its rows have neither 2D nor 3D"])
    number = np.isfinite(seen).all(-1)
    known = number & (seen != 0).any(-1)
    said = list(notes)
    confidence = known.astype(np.float64)
    if given is not None:
        number, known = number & np.isfinite(given), known & np.isfinite(given)
        confidence, words = _confidence(np.where(known, given, 0.0))
        said += words
    if not number.all():
        said.append(f"{(~number).sum()} of {number.size} points are not numbers: left out")
    skeleton, places = recognise(np.where(known[..., None], seen, np.nan), names, path)
    lacking = places < 0

    def ours(values: np.ndarray | None) -> np.ndarray | None:
        """Values [N,K,D] of the points that are known, at BlazePose's places [N,33,D]."""
        return None if values is None else np.where((lacking | ~known[:, places])[..., None], np.nan, values[:, places])

    return GivenLandmarks(
        path=path,
        tool=tool,
        skeleton=skeleton,
        xy=ours(xy),
        confidence=np.where(lacking, 0.0, confidence[:, places]),
        world=ours(world),
        names=None if rows[0].name is None else tuple(str(one.name) for one in rows),
        numbers=None if rows[0].number is None else np.array([one.number for one in rows]),
        times=times,
        tracks=tuple(one.track or "" for one in rows) if any(one.track for one in rows) or _twice(rows) else None,
        notes=tuple(said),
    )


def _stacked(values: Sequence[np.ndarray | None], path: str) -> np.ndarray | None:
    """Arrays of all rows as one; StageError where one row has another number of points."""
    given = [one for one in values if one is not None]
    if not given:
        return None
    if len(given) < len(values) or len({one.shape for one in given}) > 1:
        counts = sorted({len(one) for one in given})
        raise StageError(f"{path} has other points in one picture than in another", HINT, [f"there are {counts}"])
    return np.stack(given).astype(np.float64)


def _twice(rows: Sequence[Row]) -> bool:
    """Whether a picture has several rows."""
    pictures = [(one.name, one.number) for one in rows if (one.name, one.number) != (None, None)]
    return len(set(pictures)) < len(pictures)


def _confidence(given: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Confidences as 0..1, and what was said of it."""
    most = float(np.percentile(given, SHARE[1])) if given.size else 0.0
    unit = next((unit or most for limit, unit in SCALES if most <= limit), most)
    notes = [] if unit == 1 else [f"its confidences go up to {given.max():.3g}: taken as shares of {unit:.3g}"]
    return (given / unit).clip(0, 1), notes


def in_pixels(given: GivenLandmarks, size: tuple[int, int]) -> GivenLandmarks:
    """The same with `xy` in px of pictures of `size`, where they are shares of width and height (0..1, or -1..1)."""
    if given.xy is None:
        return given
    sure = given.xy[np.isfinite(given.xy).all(-1) & (given.confidence > 0)]
    if not len(sure):
        raise StageError(f"{given.path} holds no landmark with a place and a confidence", HINT)
    low, high = np.percentile(sure, SHARE)
    if high > NORMALISED or low < -NORMALISED:
        return given
    centred = bool(low < -0.25)
    xy = (0.5 * (given.xy + 1) if centred else given.xy) * np.array(size)
    span = "-1 to 1" if centred else "0 to 1"
    note = f"{PurePath(given.path).name} has places from {span}: taken as shares of the picture, {size[0]}x{size[1]}"
    return replace(given, xy=xy, notes=(*given.notes, note))

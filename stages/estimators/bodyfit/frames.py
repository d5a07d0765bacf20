"""Joins the rows of a fit, or of landmarks, to frames: by picture name, by frame number or by time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.facts import Listing
from stages.formats.frame_names import film_numbers, number, stem
from stages.formats.given_fits.record import SmplFit

GAP = 0.25  # s; poses farther apart are not interpolated
HINT = "add `names` [N] to the file: the frame of each row, as in frames.json (the frame's number in the video)"
_ROTATIONS = ("global_orient", "body_pose", "turns")
_NUMBERS = ("betas", "transl", "scale")


class Rows(Protocol):
    """What a file says of whom in which picture; as `SmplFit` and `GivenLandmarks`. `what` is what its rows are."""

    @property
    def path(self) -> str: ...
    @property
    def tool(self) -> str: ...
    @property
    def what(self) -> str: ...
    @property
    def names(self) -> tuple[str, ...] | None: ...
    @property
    def numbers(self) -> np.ndarray | None: ...
    @property
    def times(self) -> np.ndarray | None: ...
    @property
    def tracks(self) -> tuple[str, ...] | None: ...
    def __len__(self) -> int: ...


def join_frames(fit: SmplFit, listing: Listing) -> tuple[SmplFit, np.ndarray]:
    """The rows of `fit` that belong to frames of `listing`, and the place of each one's frame there [M]; frames in order.

    Poses with times are read off between their neighbours. StageError as `matching_rows`.
    """
    if fit.times is not None:
        return _resample(fit, fit.times, listing)
    pairs, said = matching_rows(fit, listing)
    fit = replace(fit, notes=(*fit.notes, *said))
    return fit.rows([row for _, row in pairs]), np.array([frame for frame, _ in pairs])


def matching_rows(fit: Rows, listing: Listing) -> tuple[list[tuple[int, int]], list[str]]:
    """(place of the frame in `listing`, row) of rows without times, frames in order, and what is to be said of it.

    StageError where numbers or rows count other pictures than the clip has frames, if no frame has a row, or if two rows of one
    person claim one frame.
    """
    total = listing.video.frames
    if fit.names is None and fit.numbers is None and len(fit) != total > 0:
        facts = [
            f"it has {len(fit)} {fit.what}, the clip {total} frames; by order they are joined only where there is one for each"
        ]
        raise StageError(f"{fit.path} does not name the frames of its {fit.what}", HINT, facts)
    said: list[str] = []
    keys, wanted, sure = _keys(fit, listing, said.append)
    place = {key: i for i, key in enumerate(wanted)}
    pairs = sorted((place[key], row) for row, key in enumerate(keys) if key is not None and key in place)
    if fit.tracks is None:
        _check_once(keys, fit.path)
    found = {frame for frame, _ in pairs}
    if not found or (not sure and len(found) < len(wanted) / 2):
        _refuse(fit, listing, len(found))
    return pairs, said


def _keys(fit: Rows, listing: Listing, say: Callable[[str], None]) -> tuple[list, list, bool]:
    """Keys of the rows and of the frames that match each other; and whether they are names, not mere counts."""
    names, sources = ([frame.name for frame in listing.frames], [stem(frame.source) for frame in listing.frames])
    counted, what = [frame.index for frame in listing.frames], f"{fit.what} of {Path(fit.path).name}"
    stems = [stem(name) for name in fit.names or ()]
    if fit.names is None and fit.numbers is None:
        return list(range(len(fit))), counted, False
    given = [number(name) for name in stems] if fit.numbers is None else fit.numbers.tolist()
    start, leaves = None if fit.numbers is None else 0, fit.tracks is not None
    numbers, first = film_numbers(listing, given, what, say, start, leaves)
    kinds = [names, sources] if fit.tool == "npz" else [sources, names]
    if fit.numbers is not None or first:  # a tool that counts its own pictures, perhaps from 1
        kinds = [sources]
    for called in kinds:
        if {*stems} & {*called} - {""}:
            return stems, called, True
    return numbers, counted, fit.numbers is None


def _refuse(fit: Rows, listing: Listing, found: int) -> None:
    names, has = [frame.name for frame in listing.frames], f"rows 0 to {len(fit) - 1}"
    if fit.numbers is not None:
        has = f"frames {fit.numbers.min()} to {fit.numbers.max()}"
    elif fit.times is not None:
        has = f"times {fit.times[0]:.2f} to {fit.times[-1]:.2f} s"
    elif fit.names is not None:
        has = f"{fit.names[0]} to {fit.names[-1]}"
    facts = [f"the file has {has} ({len(fit)}), the clip {names[0]} to {names[-1]} ({len(names)})"]
    hint = HINT if fit.tool == "npz" else f"let {fit.tool} run on this very video"
    raise StageError(f"{len(names) - found} of {len(names)} frames have no row in {fit.path}", hint, facts)


def _check_once(keys: list, path: str) -> None:
    named = [key for key in keys if key is not None]
    if len(set(named)) != len(named):
        twice = sorted({str(key) for key in named if named.count(key) > 1})
        raise StageError(f"two rows of {path} name the same frame", HINT, [f"{', '.join(twice[:5])}"])


def between(fit: Rows, taken: np.ndarray, listing: Listing) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of rows `taken` at times [N] s: which frames of `listing` [M] they hold, and of each the rows before and after it, and its
    share [M] of the way from the one to the other. StageError if that are less than half of the frames."""
    step = float(np.median(np.diff(taken))) if len(fit) > 1 else 0.0
    times = np.array([frame.time_s for frame in listing.frames], np.float64)
    after = (
        np.clip(np.searchsorted(taken, times), 1, max(len(fit) - 1, 1)) if len(fit) > 1 else np.zeros(len(times), int)
    )
    before = np.maximum(after - 1, 0)
    width = taken[after] - taken[before]
    share = np.clip((times - taken[before]) / np.where(width > 0, width, 1), 0, 1)
    near = np.minimum(abs(times - taken[before]), abs(times - taken[after])) <= step / 2 + 1e-6
    inside = (times >= taken[0]) & (times <= taken[-1]) & (width <= max(GAP, 3 * step))
    frames = np.flatnonzero(near | inside)
    if len(frames) < max(1, len(times) / 2):
        _refuse(fit, listing, len(frames))
    return frames, before[frames], after[frames], share[frames]


def _resample(fit: SmplFit, taken: np.ndarray, listing: Listing) -> tuple[SmplFit, np.ndarray]:
    """The poses `taken` at times [N] s as they are when the frames of `listing` were taken.

    Rotations take the shortest turn, the rest goes along straight lines.
    """
    frames, before, after, share = between(fit, taken, listing)
    times = np.array([frame.time_s for frame in listing.frames], np.float64)
    parts: dict[str, Any] = {"times": times[frames]}
    for key in _NUMBERS:
        value = getattr(fit, key)
        if value is not None:
            part = share.reshape(-1, *[1] * (value.ndim - 1))
            parts[key] = (1 - part) * value[before] + part * value[after]
    for key in _ROTATIONS:
        value = getattr(fit, key)
        if value is not None:
            parts[key] = _interpolate_rotations(value[before], value[after], share)
    return replace(fit, **parts), frames


def _interpolate_rotations(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Rotation vectors [N,3J] that are `share` [N] of the shortest turn on from `a` to `b`."""
    joints = a.shape[1] // 3
    start, end = (Rotation.from_rotvec(v.reshape(-1, 3)) for v in (a, b))
    way = (start.inv() * end).as_rotvec() * np.repeat(share, joints)[:, None]
    return (start * Rotation.from_rotvec(way)).as_rotvec().reshape(a.shape)

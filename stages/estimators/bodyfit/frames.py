"""Joins the poses of a fit to frames: by picture name, by frame number or by time, never by place in a list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.frame_names import check_numbers, count_from_one, number
from stages.formats.given_fits.record import SmplFit

GAP = 0.25  # s; poses farther apart are not interpolated
HINT = "add `names` [N] to the file: the frame of each row, as in frames.json (the frame's number in the video)"
_ROTATIONS = ("global_orient", "body_pose", "turns")
_NUMBERS = ("betas", "transl", "scale")


def join_frames(
    fit: SmplFit, names: Sequence[str], times: np.ndarray, sources: Sequence[str] = (), total: int = 0
) -> tuple[SmplFit, np.ndarray]:
    """The rows of `fit` that belong to frames, and the place of each one's frame in `names` [M]; frames in order.

    `names` are numbers of frames in the video, taken at `times` [F] s; `sources` are the names of the pictures they came
    from, if they came from pictures. The clip has `total` frames, 0 if that is not known: by it names are seen to count from
    1, and rows without names to be one for each. Poses with times are read off between their neighbours. StageError if no
    frame has a row, or two rows of a fit of one person claim one frame.
    """
    if fit.times is not None:
        return _resample(fit, fit.times, names, times)
    if fit.names is None and fit.numbers is None and len(fit) != total > 0:
        facts = [
            f"it has {len(fit)} poses, the clip {total} frames; by order they are joined only where there is one for each"
        ]
        raise StageError(f"nothing in {fit.path} tells which frames its poses are of", HINT, facts)
    if not sources and fit.names is not None and fit.numbers is None:
        stems = [Path(name).stem for name in fit.names]
        if count_from_one(total, stems):
            told = f"{total} is among the names and 0 is not: they are taken to count the frames from 1"
            numbers = [number(name) for name in stems]
            counts = np.array([-1 - i if counted is None else counted - 1 for i, counted in enumerate(numbers)])
            fit = replace(fit, names=None, numbers=counts, notes=(*fit.notes, told))
    if not sources and fit.numbers is not None:
        doubt = check_numbers(fit.numbers.tolist(), total, f"poses of {Path(fit.path).name}", "VIDEO")
        fit = replace(fit, notes=(*fit.notes, *[doubt] * (fit.tracks is None and doubt != "")))
    keys, wanted, sure = _keys(fit, names, sources)
    place = {key: i for i, key in enumerate(wanted)}
    pairs = [(place[key], row) for row, key in enumerate(keys) if key is not None and key in place]
    if fit.tracks is None:
        _check_once(keys, fit.path)
    found = {frame for frame, _ in pairs}
    if not found or (not sure and len(found) < len(names) / 2):
        _refuse(fit, names, len(found))
    pairs.sort()
    return fit.rows([row for _, row in pairs]), np.array([frame for frame, _ in pairs])


def _keys(fit: SmplFit, names: Sequence[str], sources: Sequence[str]) -> tuple[list, list, bool]:
    """Keys of the rows and of the frames that match each other; and whether they are names, not mere counts."""
    if fit.names is not None:
        stems = [Path(name).stem for name in fit.names]
        both = [list(names), [Path(name).stem for name in sources]]
        for called in both if fit.tool == "npz" else both[::-1]:
            if fit.numbers is not None and called == both[0]:
                continue  # a tool that counts its own pictures, perhaps from 1
            if set(stems) & set(called):
                return stems, called, True
    numbers = [number(name) for name in names]
    if fit.numbers is not None:
        return fit.numbers.tolist(), numbers, False
    if fit.names is not None:
        return [number(stem) for stem in stems], numbers, True
    return list(range(len(fit))), numbers, False


def _refuse(fit: SmplFit, names: Sequence[str], found: int) -> None:
    has = f"rows 0 to {len(fit) - 1}"
    if fit.numbers is not None:
        has = f"frames {fit.numbers.min()} to {fit.numbers.max()}"
    elif fit.times is not None:
        has = f"times {fit.times[0]:.2f} to {fit.times[-1]:.2f} s"
    elif fit.names is not None:
        has = f"{fit.names[0]} to {fit.names[-1]}"
    facts = [f"the fit has {has} ({len(fit)}), the clip {names[0]} to {names[-1]} ({len(names)})"]
    hint = HINT if fit.tool == "npz" else f"let {fit.tool} run on this very video"
    raise StageError(f"{len(names) - found} of {len(names)} frames have no row in {fit.path}", hint, facts)


def _check_once(keys: list, path: str) -> None:
    named = [key for key in keys if key is not None]
    if len(set(named)) != len(named):
        twice = sorted({str(key) for key in named if named.count(key) > 1})
        raise StageError(f"two rows of {path} name the same frame", HINT, [f"{', '.join(twice[:5])}"])


def _resample(fit: SmplFit, taken: np.ndarray, names: Sequence[str], times: np.ndarray) -> tuple[SmplFit, np.ndarray]:
    """The poses `taken` at times [N] s as they are at the frames' `times` [F] s.

    Rotations take the shortest turn, the rest goes along straight lines.
    """
    step = float(np.median(np.diff(taken))) if len(fit) > 1 else 0.0
    times = np.asarray(times, np.float64)
    after = (
        np.clip(np.searchsorted(taken, times), 1, max(len(fit) - 1, 1)) if len(fit) > 1 else np.zeros(len(times), int)
    )
    before = np.maximum(after - 1, 0)
    width = taken[after] - taken[before]
    share = np.clip((times - taken[before]) / np.where(width > 0, width, 1), 0, 1)
    near = np.minimum(abs(times - taken[before]), abs(times - taken[after])) <= step / 2 + 1e-6
    inside = (times >= taken[0]) & (times <= taken[-1]) & (width <= max(GAP, 3 * step))
    frames = np.flatnonzero(near | inside)
    if len(frames) < max(1, len(names) / 2):
        _refuse(fit, names, len(frames))
    before, after, share = before[frames], after[frames], share[frames]
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

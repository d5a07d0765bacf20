"""Landmarks of another program in place of BlazePose's: joined to frames, of the right person, brought into our pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.estimators.bodyfit.agreement import EXCHANGED, LEAST, OFF, SURE, astray, compare, correction, turned
from stages.estimators.bodyfit.frames import between, matching_rows
from stages.formats.datasets.undistorted import Grid, lens_points, pinhole_points
from stages.formats.facts import Listing
from stages.formats.frame_names import plain
from stages.formats.given_landmarks.recognize import read_landmark_file
from stages.formats.given_landmarks.record import GivenLandmarks
from stages.formats.landmarks import COUNT, MIRRORED, NAMES
from stages.records import SeenLandmarks

MANY = 20  # people of a file that are compared, those in most frames


@dataclass(frozen=True)
class Seen:
    """Somebody in a frame: `xy` [33,2] px (NaN: unknown), `confidence` [33], `world` [33,3]."""

    track: str
    xy: np.ndarray
    confidence: np.ndarray
    world: np.ndarray


def film_size(listing: Listing) -> tuple[int, int]:
    """Width and height in px of the film's own pictures."""
    return (listing.video.width or listing.width, listing.video.height or listing.height)


def check_landmarks(path: Path, clip: Listing) -> None:
    """StageError for a file that holds no landmarks, or none of a clip of which any frames may be picked (see `whole_clip`)."""
    for _, one in _people(read_landmark_file(path, film_size(clip))):
        if one.times is None:
            matching_rows(one, clip)


def given_landmarks(
    path: Path,
    listing: Listing,
    tracks: Sequence[SeenLandmarks | None],
    grid_of: Callable[[str], Grid | None],
    viewmats: np.ndarray,
    say: Callable[[str], None],
) -> tuple[list[SeenLandmarks | None], dict[str, Any]]:
    """The landmarks in a file, of the person whom BlazePose's `tracks` of the frames in `listing` show, and facts for smpl.json.

    Points that the file lacks have visibility 0; what lies deeper comes from BlazePose where the file has no 3D. The file's
    pixels are the film's, with its lens; those returned are of the pinhole pictures. StageError where nobody in the file is
    where the person is.
    """
    given = read_landmark_file(path, film_size(listing))
    name = plain(path.name)
    there, notes = people_in(given, listing)
    grids = [grid_of(frame.name) for frame in listing.frames]
    seen, visibility, height = _as_arrays(tracks, grids)
    facts: dict[str, Any] = {"skeleton": given.skeleton, "rows": len(given), "3d": given.world is not None}
    said = [*given.notes, *notes]
    best, corrected = "", lambda one: one
    if given.xy is not None:
        best, corrected, words = _correct(there, seen, visibility, height, (listing.width, listing.height), name)
        said += [f"the landmarks of {name} {word}" for word in words]
    chosen = [_pick(each, corrected, seen[i], height[i], best) for i, each in enumerate(there)]
    if given.xy is not None:
        xy, confidence = _stacked(chosen)
        wrong = astray(xy, confidence, seen, visibility, height)
        if wrong:
            facts["astray"] = [NAMES[k] for k in wrong]
            said.append(f"{', '.join(facts['astray'])} of {name} are another part of the body: left out")
            for one in filter(None, chosen):
                one.confidence[wrong] = 0
    if given.world is not None:
        world = np.stack([_VOID["world"] if one is None else one.world for one in chosen])
        sure = np.stack([_VOID["confidence"] if one is None else one.confidence for one in chosen])
        world, axes = turned(world, sure, tracks, viewmats)
        said += [f"the 3D landmarks of {name} have {axes}"] if axes else []
        chosen = [None if one is None else replace(one, world=deep) for one, deep in zip(chosen, world, strict=True)]
    for note in said:
        say(note)
    facts["corrected"] = said
    merged = [
        _merge(one, track, seen[i], grid, given)
        for i, (one, track, grid) in enumerate(zip(chosen, tracks, grids, strict=True))
    ]
    facts["frames"] = sum(one is not None for one in chosen)
    return merged, facts


def people_in(given: GivenLandmarks, listing: Listing) -> tuple[list[list[Seen]], list[str]]:
    """Everybody that the file has in each frame of `listing`, in px of its frames, and notes."""
    ratio = np.array([listing.width, listing.height]) / film_size(listing)
    found: list[list[Seen]] = [[] for _ in listing.frames]
    notes: list[str] = []
    for who, one in _people(given):
        if one.times is not None:
            rows = list(zip(*(part.tolist() for part in between(one, one.times, listing)), strict=True))
        else:
            pairs, said = matching_rows(one, listing)
            rows, notes = [(frame, row, row, 0.0) for frame, row in pairs], [*notes, *said]
        for frame, a, b, share in rows:
            xy, world = (
                void if values is None else (1 - share) * values[a] + share * values[b]
                for values, void in ((one.xy, _VOID["xy"]), (one.world, _VOID["world"]))
            )
            confidence = np.minimum(one.confidence[a], one.confidence[b])
            track = one.tracks[a] if one.tracks is not None else who
            found[frame].append(Seen(track, xy * ratio, confidence.copy(), world))
    return found, notes


def _people(given: GivenLandmarks) -> list[tuple[str, GivenLandmarks]]:
    """The file as it is where its rows name their pictures, else each person with their id: rows are joined by order or time."""
    if given.tracks is None or given.names is not None or given.numbers is not None:
        return [("", given)]
    of = {one: [i for i, track in enumerate(given.tracks) if track == one] for one in dict.fromkeys(given.tracks)}
    return [(one, replace(given.rows(rows), tracks=None)) for one, rows in of.items()]


_VOID = {"xy": np.full((COUNT, 2), np.nan), "confidence": np.zeros(COUNT), "world": np.full((COUNT, 3), np.nan)}


def _as_arrays(
    tracks: Sequence[SeenLandmarks | None], grids: Sequence[Grid | None]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """BlazePose's landmarks [F,33,2] px with the film's lens, NaN for nobody, their visibility, and the person's height [F] px."""
    seen = np.stack([_VOID["xy"] if one is None else np.asarray(one.xy, np.float64) for one in tracks])
    visibility = np.stack([_VOID["confidence"] if one is None else np.asarray(one.visibility) for one in tracks])
    for i, grid in enumerate(grids):
        if grid is not None and tracks[i] is not None:
            seen[i] = lens_points(seen[i], grid)
    known = [one is not None for one in tracks]
    height = np.ones(len(seen))
    height[known] = np.maximum(np.hypot(*np.ptp(seen[known], axis=1).T), 1)
    return seen, visibility, height


def _correct(
    there: Sequence[Sequence[Seen]],
    seen: np.ndarray,
    visibility: np.ndarray,
    height: np.ndarray,
    size: tuple[int, int],
    name: str,
) -> tuple[str, Callable[[Seen], Seen], list[str]]:
    """Who of the file is the person, how everybody's landmarks are brought into our pixels, and words for it."""
    tracks = [one.track for each in there for one in each]
    found = {}
    for track in sorted(set(tracks), key=tracks.count, reverse=True)[:MANY]:
        rows = [[one for one in each if one.track == track] for each in there]
        picked = [_pick(each, lambda one: one, seen[i], height[i], track) for i, each in enumerate(rows)]
        xy, confidence = _stacked(picked)
        found[track] = compare(xy, confidence, seen, visibility, height)
    known = {track: one for track, one in found.items() if one is not None}
    if not known:
        both = sum(bool(each) and np.isfinite(seen[i]).any() for i, each in enumerate(there))
        facts = [f"{both} frames of the file show somebody to BlazePose; {LEAST} are needed"]
        hint = "give masks of the person with --masks, so that BlazePose knows where to look"
        raise StageError(f"the landmarks of {name} can be compared with nothing", hint, facts)
    ranked, refused = sorted(known, key=lambda track: known[track].off), []
    for best in ranked:  # somebody who moves alike beside the person is as near but for a shift
        try:
            scale, shift, words = correction(known[best], size, float(np.median(height)), name)
            break
        except StageError as error:
            refused.append(error)
    else:
        raise refused[0]
    order = MIRRORED if known[best].swapped else np.arange(COUNT)
    if len(set(tracks)) > 1:
        words = [f"are of {len(set(tracks))} people: {best or 'the one without an id'} is the person", *words]

    def corrected(one: Seen) -> Seen:
        return Seen(one.track, one.xy[order] * scale + shift, one.confidence[order], one.world[order])

    return best, corrected, words


def _stacked(rows: Sequence[Seen | None]) -> tuple[np.ndarray, np.ndarray]:
    """Places [F,33,2] and confidences [F,33], NaN and 0 for nobody."""
    void = Seen("", _VOID["xy"], _VOID["confidence"], _VOID["world"])
    each = [one or void for one in rows]
    return np.stack([one.xy for one in each]), np.stack([one.confidence for one in each])


def _pick(
    each: Sequence[Seen], corrected: Callable[[Seen], Seen], seen: np.ndarray, height: float, best: str
) -> Seen | None:
    """Of everybody in a frame the one where BlazePose has `seen` [33,2] the person, else the one of track `best`, if any."""
    rows = [corrected(one) for one in each]
    gaps = [np.nanmedian(np.r_[np.linalg.norm(one.xy - seen, axis=1), np.inf]) for one in rows]
    if rows and (min(gaps) < 2 * OFF * height or len({one.track for one in rows}) == 1):
        return rows[int(np.argmin(gaps))]
    return next((one for one in rows if one.track == best), None)


def _merge(
    one: Seen | None, track: SeenLandmarks | None, seen: np.ndarray, grid: Grid | None, given: GivenLandmarks
) -> SeenLandmarks | None:
    """The landmarks of a frame: the file's, and where it has none BlazePose's places with visibility 0, and its 3D.

    `seen` [33,2] px are BlazePose's with the lens.
    """
    if one is None:
        return None
    blank = SeenLandmarks(_VOID["xy"], _VOID["confidence"], _VOID["world"])
    base = blank if track is None else _same_sides(track, seen, one)
    deep = np.where(np.isfinite(one.world), one.world, base.world)
    if given.xy is None:
        return replace(blank, xy=base.xy, visibility=base.visibility, world=deep) if track else None
    known = np.isfinite(one.xy).all(-1)
    xy = np.array(base.xy, np.float64)
    xy[known] = one.xy[known] if grid is None else pinhole_points(one.xy[known], grid)
    torso = [k for k, name in enumerate(NAMES) if name.endswith(("_shoulder", "_hip"))]
    if not np.isfinite(xy[torso]).all():
        return None
    return SeenLandmarks(xy, np.where(known, one.confidence, 0.0), deep)


def _same_sides(track: SeenLandmarks, seen: np.ndarray, one: Seen) -> SeenLandmarks:
    """BlazePose's landmarks with the sides that the file has, where it exchanged them in this frame."""
    sure = np.isfinite(one.xy).all(-1) & (one.confidence >= SURE)
    off, exchanged = (
        np.linalg.norm(one.xy[sure] - seen[order][sure], axis=1).sum() for order in (np.arange(COUNT), MIRRORED)
    )
    if exchanged >= EXCHANGED * off:
        return track
    return SeenLandmarks(track.xy[MIRRORED], track.visibility[MIRRORED], track.world[MIRRORED])

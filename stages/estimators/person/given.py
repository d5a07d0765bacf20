"""Joins masks of another program to a clip's frames: by name, with the right object as the person, and the right polarity."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from stages.contract import Job, StageError
from stages.estimators.words import listed
from stages.formats.facts import Listing
from stages.formats.frame_names import join, matching, plain
from stages.formats.given_masks.mask_set import MaskSet
from stages.formats.given_masks.objects import Object, objects_of, pick
from stages.formats.given_masks.recognize import read_mask_files
from stages.formats.images import same_shape
from stages.formats.people import EVERYBODY
from stages.formats.whole_clip import DECODED_SHARE


def import_masks(
    job: Job, path: Path, listing: Listing, invert: Literal["auto", "always", "never"], person: int | str | None
) -> tuple[dict[str, Any], Iterator[list[np.ndarray]]]:
    """Facts for masks.json, and for each frame in `listing` (frames.json) the mask uint8 [H,W], 255 = person.

    Where `person` is EVERYBODY it is a mask for each object, the largest and most frequent first. Raises StageError if frames
    have no mask, if masks have the shape of other pictures, if `person` is unknown, or if several people's are to be inverted.
    """
    total, names = listing.video.frames, [frame.name for frame in listing.frames]
    given, joined = joined_masks(path, listing, range(total, total + 1), job.warn)
    if len(joined) < len(names):
        raise lacking(given, joined, listing)
    rows = [joined[name] for name in names]
    objects = objects_of(given, rows)
    chosen = objects if person == EVERYBODY else [pick(objects, person)]
    report_objects(job, objects, chosen)
    if len(chosen) > 1 and invert == "always":
        raise StageError(
            "masks of several people cannot be inverted: pixels that none of them marks belong to nobody",
            "leave out `--set masks.invert=always`, or choose one with `--person ID`",
            [f"{len(chosen)} objects: {', '.join(one.id for one in chosen)}"],
        )
    inverted = len(chosen) == 1 and polarity(job, chosen[0], invert)
    encodings = {str(levels): levels.files for levels in chosen[0].levels.values()}
    job.note(f"{given.kind}: " + "; ".join(f"{words} ({count} files)" for words, count in encodings.items()))
    details = {
        "folder": plain(path.name),
        "kind": given.kind,
        "inverted": inverted,
        "encodings": encodings,
        "unused": (total if given.names is None else len(given.names)) - len(set(rows)),
        "person": chosen[0].id if len(chosen) == 1 else [one.id for one in chosen],
    }
    size = (listing.width, listing.height)
    masks = ([frame_mask(one, i, size, name, inverted) for one in chosen] for name, i in zip(names, rows))
    return details, masks


def check_masks(path: Path, clip: Listing) -> None:
    """StageError for files that are no masks, or not of a clip of which any frames may be picked (see `whole_clip`): too
    many or too few, none with a frame's name, or the first of another shape."""
    total = clip.video.frames
    may_decode = range(round(DECODED_SHARE * total), total + 1)
    given, joined = joined_masks(path, clip, may_decode, lambda doubt: None)
    if not joined:
        raise lacking(given, joined, clip)
    name, row = next(iter(joined.items()))
    if found := next(filter(None, (given.read(one, row) for one in given.objects)), None):
        check_shape(found[0].shape, (clip.width, clip.height), name)


def joined_masks(
    path: Path, listing: Listing, frames: range, warn: Callable[[str], None]
) -> tuple[MaskSet, dict[str, int]]:
    """The given masks, and of each frame that has one its place among them; StageError as `read_mask_files` and `join`."""
    given = read_mask_files(path, frames, listing.video.path)
    if given.names is None:
        return given, {frame.name: frame.index for frame in listing.frames}
    return given, join(listing, given.names, "masks", warn)


def lacking(given: MaskSet, joined: Mapping[str, int], listing: Listing) -> StageError:
    """The error for frames without a mask."""
    missing = [frame.name for frame in listing.frames if frame.name not in joined]
    return StageError(
        f"masks are missing for {len(missing)} of {len(listing.frames)} frames",
        f"name each mask by its frame's number in the video, or leave out --masks; {matching(listing)}",
        [f"missing: {listed(missing)}", f"given, as {given.kind}: {listed(given.names or ())}"],
    )


def report_objects(job: Job, objects: list[Object], chosen: list[Object]) -> None:
    """List the objects if there are several, and name the one that is followed, or each."""
    first = chosen[0]
    if len(chosen) > 1:
        said = "; ".join(f"person {k} is {one}" for k, one in enumerate(chosen, 1))
        job.note(f"{len(chosen)} objects in the given masks: {said}")
    elif len(objects) > 1:
        more = f" and {len(objects) - 8} more" if len(objects) > 8 else ""
        job.note(f"{len(objects)} objects in the given masks: {'; '.join(map(str, objects[:8]))}{more}")
        job.warn(f"following object {first.id} of {len(objects)}; `--person ID` picks another")
    elif len(first.labels) > 1:
        job.note(f"labels {', '.join(map(str, sorted(first.labels)))} touch nearly always: parts of one person")


def polarity(job: Job, person: Object, invert: Literal["auto", "always", "never"]) -> bool:
    """Whether the masks mark the background instead of the person; a note gives the numbers."""
    masks = (mask for i in person.levels if (mask := person.read(i)) is not None)
    shares = [(float((mask > 127).mean()), border_share(mask)) for mask in masks]
    area, border = (sum(part) / len(shares) for part in zip(*shares))
    inverted = invert == "always" or (invert == "auto" and area > 0.5 and border > 0.5)
    marked = f"marked: {area:.0%} of the picture, {border:.0%} of its border"
    job.note(f"given masks {'inverted' if inverted else 'taken as they are, white = person'} ({marked})")
    if invert == "auto" and (area > 0.5) != (border > 0.5):
        job.warn(f"unsure whether the given masks mark the person ({marked}); see --set masks.invert=always|never")
    return inverted


def frame_mask(person: Object, row: int, size: tuple[int, int], name: str, invert: bool) -> np.ndarray:
    """The person's mask in a frame at the frames' size, white, empty where the person is not.

    StageError if its shape is that of another picture.
    """
    if (mask := person.read(row)) is None:
        return np.zeros(size[::-1], np.uint8)
    check_shape(mask.shape, size, name)
    height, width = mask.shape
    if (width, height) != size:
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR)
    return 255 - mask if invert else mask


def check_shape(mask: tuple[int, ...], size: tuple[int, int], name: str) -> None:
    """StageError where a mask (height, width) has another shape than the frames, whose `size` is (width, height)."""
    height, width = mask
    if not same_shape((width, height), size):
        raise StageError(
            f"the mask of frame {name} is not a mask of these frames",
            "make masks from the same video, upright as a player shows it",
            [f"mask {width}x{height}, frames {size[0]}x{size[1]}"],
        )


def border_share(mask: np.ndarray) -> float:
    """Share of the picture's outermost pixels that are marked."""
    return float((np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]) > 127).mean())

"""Joins masks of another program to a clip's frames: by name, with the right object as the person, and the right polarity."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from stages.contract import Job, StageError
from stages.estimators.words import listed
from stages.formats.facts import Listing
from stages.formats.frame_names import count_from_one, has_sources, join, matching, plain
from stages.formats.given_masks.mask_set import MaskSet
from stages.formats.given_masks.objects import Object, labeled_objects, pick, ranked
from stages.formats.given_masks.recognize import read_mask_files
from stages.formats.given_masks.values import ForeignMasks
from stages.formats.images import same_shape
from stages.formats.people import EVERYBODY


@dataclass(frozen=True)
class MaskedPerson:
    """The masks of one person: `masks` reads those in `rows`; of label masks only `labels` count (None: all)."""

    id: str
    masks: ForeignMasks
    rows: frozenset[int]
    labels: frozenset[int] | None = None


def import_masks(
    job: Job, path: Path, listing: Listing, invert: Literal["auto", "always", "never"], person: int | str | None
) -> tuple[dict[str, Any], Iterator[list[np.ndarray]]]:
    """Facts for masks.json, and for each frame in `listing` (frames.json) the mask uint8 [H,W], 255 = person.

    Where `person` is EVERYBODY it is a mask for each object, the largest and most frequent first. Raises StageError if frames
    have no mask, if masks have the shape of other pictures, if `person` is unknown, or if several people's are to be inverted.
    """
    total, names = listing.video.frames, [frame.name for frame in listing.frames]
    given = read_mask_files(path, total, listing.video.path)
    joined = join_masks(job, listing, given.names)
    missing = [name for name in names if name not in joined]
    if missing:
        raise StageError(
            f"masks are missing for {len(missing)} of {len(names)} frames",
            f"name each mask by its frame's number in the video, or leave out --masks; {matching(listing)}",
            [f"missing: {listed(missing)}", f"given, as {given.kind}: {listed(given.names or ())}"],
        )
    rows = [joined[name] for name in names]
    people = masked_people(given, rows, person)
    if person == EVERYBODY:
        chosen = [one for _, one in people]
        if len(people) > 1:
            said = "; ".join(f"person {k} is {found or 'object'}" for k, (found, _) in enumerate(people, 1))
            job.note(f"{len(people)} objects in the given masks: {said}")
    else:
        chosen = [pick_masks(job, people, person)]
    if len(chosen) > 1 and invert == "always":
        raise StageError(
            "masks of several people cannot be inverted: what none of them marks is nobody's",
            "leave out `--set masks.invert=always`, or choose one with `--person ID`",
            [f"{len(chosen)} objects: {', '.join(one.id for one in chosen)}"],
        )
    inverted = len(chosen) == 1 and polarity(job, chosen[0], invert)
    encodings = chosen[0].masks.encodings()
    job.note(f"{given.kind}: " + "; ".join(f"{words} ({count} files)" for words, count in encodings.items()))
    unused = (total if given.names is None else len(given.names)) - len(set(rows))
    details = {
        "folder": plain(path.name),
        "kind": given.kind,
        "inverted": inverted,
        "encodings": encodings,
        "unused": unused,
    }
    size = (listing.width, listing.height)
    details |= {"person": chosen[0].id if len(chosen) == 1 else [one.id for one in chosen]}
    frames = list(zip(names, rows, strict=True))
    each = (resize_masks(one, frames, size, inverted) for one in chosen)
    return details, (list(masks) for masks in zip(*each, strict=True))


def join_masks(job: Job, listing: Listing, names: tuple[str, ...] | None) -> dict[str, int]:
    """Frame name -> row of its mask: by the same stem, else by the frame's number in the video; by order without names.

    Files numbered from 1 to the number of the video's frames, with no 0, count from 1; a warning says so.
    """
    if names is None:
        return {frame.name: frame.index for frame in listing.frames}
    first = int(not has_sources(listing) and count_from_one(listing.video.frames, names))
    if first:
        job.warn(f"given masks are numbered 1 to {listing.video.frames}: taken as counted from 1")
    return join(listing, names, first, "masks", job.warn)


def masked_people(
    given: MaskSet, rows: list[int], person: int | str | None
) -> list[tuple[Object | None, MaskedPerson]]:
    """All objects and their masks, the largest and most frequent first; None for the only one, which has no name."""
    if given.objects == ("",):
        masks = ForeignMasks(rows, partial(given.read, ""))
        objects = labeled_objects(masks)
        if not objects and person not in (None, EVERYBODY):
            facts = [f"{len(rows)} masks ({given.kind}), each with one object"]
            raise StageError(f"no person {person!r} in the given masks", "leave out --person", facts)
        if not objects:
            return [(None, MaskedPerson("", masks, frozenset(rows)))]
        return [(one, MaskedPerson(one.id, masks, frozenset(rows), one.labels or None)) for one in objects]
    people = {one: ForeignMasks(rows, partial(given.read, one)) for one in given.objects}
    objects = []
    for one, masks in people.items():
        shares = [share for i in masks.keys if (share := float((masks.read(i) > 127).mean()))]
        objects.append(Object(one, len(shares), sum(shares) / max(len(shares), 1)))
    objects = ranked(objects)
    if not objects:
        raise StageError("no object in the given masks is in any frame", "check the masks", [f"{len(people)} objects"])
    return [(one, MaskedPerson(one.id, people[one.id], frozenset(people[one.id].keys))) for one in objects]


def pick_masks(job: Job, people: list[tuple[Object | None, MaskedPerson]], person: int | str | None) -> MaskedPerson:
    """The masks of the person; several objects are listed with numbers, and a warning names the one that is followed."""
    objects = [found for found, _ in people if found is not None]
    if not objects:
        return people[0][1]
    chosen = pick(objects, person)
    report_objects(job, objects, chosen)
    return next(one for found, one in people if found is chosen)


def report_objects(job: Job, objects: list[Object], chosen: Object) -> None:
    """List the objects if there are several, and name the one that is followed."""
    if len(objects) > 1:
        more = f" and {len(objects) - 8} more" if len(objects) > 8 else ""
        job.note(f"{len(objects)} objects in the given masks: {'; '.join(map(str, objects[:8]))}{more}")
        job.warn(f"following object {chosen.id} of {len(objects)}; `--person ID` picks another")
    elif chosen.labels and len(chosen.labels) > 1:
        job.note(f"labels {', '.join(map(str, sorted(chosen.labels)))} touch nearly always: parts of one person")


def polarity(job: Job, person: MaskedPerson, invert: Literal["auto", "always", "never"]) -> bool:
    """Whether the masks mark the background instead of the person; a note gives the numbers."""
    areas, borders = [], []
    for i in person.rows:
        mask = person.masks.read(i, person.labels)
        areas.append(float((mask > 127).mean()))
        borders.append(border_share(mask))
    area, border = sum(areas) / len(areas), sum(borders) / len(borders)
    inverted = invert == "always" or (invert == "auto" and area > 0.5 and border > 0.5)
    marked = f"marked: {area:.0%} of the picture, {border:.0%} of its border"
    job.note(f"given masks {'inverted' if inverted else 'taken as they are, white = person'} ({marked})")
    if invert == "auto" and (area > 0.5) != (border > 0.5):
        job.warn(f"unsure whether the given masks mark the person ({marked}); see --set masks.invert=always|never")
    return inverted


def resize_masks(
    person: MaskedPerson, frames: list[tuple[str, int]], size: tuple[int, int], invert: bool
) -> Iterator[np.ndarray]:
    """The mask of each frame (name, row) at the frames' size, empty where the person is not."""
    for name, i in frames:
        if i not in person.rows:
            yield np.zeros(size[::-1], np.uint8)
        else:
            yield resize_mask(person.masks.read(i, person.labels), size, name, invert)


def resize_mask(mask: np.ndarray, size: tuple[int, int], name: str, invert: bool) -> np.ndarray:
    """A given mask at the frames' size, person white; StageError if its shape is that of another picture."""
    height, width = mask.shape
    if not same_shape((width, height), size):
        raise StageError(
            f"the mask of frame {name} is not a mask of these frames",
            "make masks from the same video, upright as a player shows it",
            [f"mask {width}x{height}, frames {size[0]}x{size[1]}"],
        )
    if (width, height) != size:
        mask = cv2.resize(mask, size, interpolation=cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR)
    return 255 - mask if invert else mask


def border_share(mask: np.ndarray) -> float:
    """Share of the picture's outermost pixels that are marked."""
    return float((np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]) > 127).mean())

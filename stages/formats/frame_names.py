"""Joins files of other programs to the frames of a clip by their names, never by their place in a list."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import PurePath

from stages.contract import StageError
from stages.formats.facts import Listing
from stages.formats.pictures import PICTURES, number

ENDINGS = (*PICTURES, ".npy")


def plain(name: str) -> str:
    """A file's name as text that JSON and pages can hold, whatever bytes it has on the disk."""
    return os.fsencode(name).decode(errors="replace")


def stem(name: str | PurePath) -> str:
    """A file's name without folders and endings, its picture's ending too (frame.jpg.png -> frame)."""
    name = plain(PurePath(name).name)
    while PurePath(name).suffix.lower() in ENDINGS:
        name = name[: -len(PurePath(name).suffix)]
    return name


def without_word(stems: Sequence[str]) -> list[str]:
    """Names without the word that each of them ends with after its number, as those of masks do: frame_0001_mask."""
    ends = {re.split(r"[0-9]+", name)[-1] for name in stems}
    end = ends.pop() if len(ends) == 1 else ""
    return [name.removesuffix(end) or name for name in stems] if re.search("[0-9]", "".join(stems)) else list(stems)


def has_sources(listing: Listing) -> bool:
    """True if the clip is a folder of pictures, whose frames have names of their own."""
    return any(frame.source for frame in listing.frames)


def extracting(film: str) -> str:
    """The hint that says how to get pictures of which each is a frame of the film."""
    make = f"`ffmpeg -i {film} -fps_mode passthrough pictures/%05d.png`"
    return f"make them from the film's own frames, which {make} writes; without the option it doubles or drops some"


def matching(listing: Listing) -> str:
    """The hint that says how masks come to be those of a clip's frames."""
    film = listing.video.path
    return f"name each as its picture in {film} is named" if has_sources(listing) else extracting(film)


def check_numbers(numbers: Sequence[int], total: int, what: str, film: str) -> str:
    """What joins by the numbers of frames, from 0, is checked against the `total` frames of the film (0: not known).

    Raises StageError where a number is beyond the film: other pictures were counted. Returns a warning where that may be, as
    the numbers run from the first frame on without a gap, and end before the film, or "".
    """
    low, high = min(numbers, default=0), max(numbers, default=0)
    if high >= total > 0:
        facts = [f"{len(numbers)} {what}, the film has {total} frames; the highest number is frame {high}, from 0"]
        raise StageError(f"{what} are of other pictures than the frames of {film}", extracting(film), facts)
    if not 0 <= low <= 1 or len({*numbers}) != high - low + 1 or not 1 < high - low + 1 < total:
        return ""
    return f"{what} are of the frames {low} to {high} of {total}, by their numbers; if they count others: {extracting(film)}"


def count_from_one(total: int, numbers: Collection[int | None]) -> bool:
    """True if numbers surely count the `total` frames of a video from 1, as ffmpeg's do: the highest is it, none is 0."""
    return 0 not in numbers and max((n for n in numbers if n is not None), default=0) == total > 0


def film_numbers(
    listing: Listing,
    numbers: Sequence[int | None],
    what: str,
    warn: Callable[[str], None],
    first: int | None = None,
    leaves: bool = False,
) -> tuple[list[int | None], int]:
    """The frames of the film, from 0, that `numbers` of frames mean, None for none; and the number of its first frame.

    That is `first`, or else found. Pictures of a folder have names of their own, so that their numbers are not checked. Raises
    StageError as `check_numbers`; `what` says what has the numbers, and `leaves` that it may be gone before the film ends.
    """
    total = listing.video.frames
    if has_sources(listing):
        return list(numbers), 0
    start = int(count_from_one(total, numbers)) if first is None else first
    if first is None and start:
        warn(f"{what} have the numbers up to {total}, but no 0: read as counted from 1")
    numbers = [n if n is None else n - start for n in numbers]
    doubt = check_numbers([n for n in numbers if n is not None], total, what, listing.video.path)
    if doubt and not leaves:
        warn(doubt)
    return numbers, start


def join(
    listing: Listing, stems: Sequence[str], what: str, warn: Callable[[str], None], first: int | None = None
) -> dict[str, int]:
    """Frame name -> place of its stem in `stems`: by name, else, in a film, by the frame's number.

    Raises StageError where two stems are one name, or as `film_numbers`, which says what `what`, `warn` and `first` are.
    """
    twice = sorted(name for name, count in Counter(stems).items() if count > 1)
    if twice:
        fact = f"{', '.join(twice[:5])}" + (f" and {len(twice) - 5} more" if len(twice) > 5 else "")
        raise StageError(f"two {what} have the name of one frame", "give one for each frame", [fact])
    row = {name: i for i, name in enumerate(stems)}
    numbers, first = film_numbers(listing, [number(name) for name in stems], what, warn, first)
    counts = Counter(numbers)
    unique = {n: i for i, n in enumerate(numbers) if n is not None and counts[n] == 1}
    joined = {}
    for frame in listing.frames:
        exact = row.get(frame.source or frame.name) if not first else None
        found = exact if exact is not None or frame.source else unique.get(frame.index)
        if found is not None:
            joined[frame.name] = found
    return joined

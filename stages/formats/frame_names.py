"""Joins files of other programs to the frames of a clip by their names, never by their place in a list."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import PurePath

from stages.contract import StageError
from stages.formats.facts import Listing
from stages.formats.pictures import PICTURES, number

ENDINGS = (*PICTURES, ".npy")


def stem(name: str | PurePath) -> str:
    """A file's name without folders and endings, its picture's ending too (frame.jpg.png -> frame)."""
    name = PurePath(name).name
    while PurePath(name).suffix.lower() in ENDINGS:
        name = name[: -len(PurePath(name).suffix)]
    return name


def has_sources(listing: Listing) -> bool:
    """True if the clip is a folder of pictures, whose frames have names of their own."""
    return any(frame.source for frame in listing.frames)


def count_from_one(total: int, stems: Sequence[str]) -> bool:
    """True if the stems surely count the `total` frames of a video from 1, as ffmpeg's do: one equals it, and none is 0."""
    numbers = {number(name) for name in stems}
    return 0 not in numbers and total in numbers


def join(listing: Listing, stems: Sequence[str], first: int, what: str) -> dict[str, int]:
    """Frame name -> place of its stem in `stems`: by name, else by the frame's number in the video plus `first`.

    `listing` is frames.json. Raises StageError where two stems are one name; `what` says what they name.
    """
    twice = sorted(name for name, count in Counter(stems).items() if count > 1)
    if twice:
        fact = f"{', '.join(twice[:5])}" + (f" and {len(twice) - 5} more" if len(twice) > 5 else "")
        raise StageError(f"two {what} have the name of one frame", "give one for each frame", [fact])
    row = {name: i for i, name in enumerate(stems)}
    numbers = [number(name) for name in stems]
    counts = Counter(numbers)
    unique = {n: i for i, n in enumerate(numbers) if n is not None and counts[n] == 1}
    joined = {}
    for frame in listing.frames:
        exact = row.get(frame.source or frame.name) if not first else None
        found = exact if exact is not None or frame.source else unique.get(frame.index + first)
        if found is not None:
            joined[frame.name] = found
    return joined

"""BVH motion capture: any skeleton, any order of channels.

Format by its inventors: https://research.cs.wisc.edu/graphics/Courses/cs-838-1999/Jeff/BVH.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from stages.contract import StageError
from stages.formats.budget import Budget, check_count
from stages.formats.motions.rates import usual_rate

HINT = "export the motion as BVH again; a text with HIERARCHY, then MOTION, one line of numbers a frame"
DIGITS = 18  # of a number of frames; Python refuses to read thousands of them
JOINT = 96  # bytes of a joint in a frame: its place and its rotation
SHORT = 0.05  # share of the frames promised that may be missing at the end, or one frame
ENCODINGS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"H\0": "utf-16-le", b"\0H": "utf-16-be"}
CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")


@dataclass(frozen=True)
class Bvh:
    """A skeleton of J joints moving for F frames, in the file's own axes and unit of length.

    `names` [J], "" for an End Site; `parents` [J], before their children, the root's is -1; `places` [F,J,3] in the
    parent's axes, the OFFSET where no channel moves it; `rotations` [F,J,3,3] from a joint's axes to its parent's;
    `fps` frames a second. `said`: what of the file was taken otherwise than it says, in sentences.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    places: np.ndarray
    rotations: np.ndarray
    fps: float
    said: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.places)


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file; StageError with the line and what was expected there.

    A position channel replaces the offset along its axis. A BVH does not say its unit of length.
    """
    try:
        text = text_of(path.read_bytes())
    except FileNotFoundError as error:
        raise StageError(f"no file {path}", HINT) from error
    except ValueError as error:
        raise StageError(f"{path} is not a text", HINT, [str(error)]) from error
    lines = _Lines(path, text)
    skeleton = _skeleton(lines)
    fps, rows, said = _motion(lines, sum(map(len, skeleton.channels)))
    joints = len(skeleton.names)
    Budget(path, len(text)).spend(JOINT * joints * len(rows), f"{joints} joints in {len(rows)} frames")
    return _bvh(skeleton, fps, rows, said)


def text_of(data: bytes) -> str:
    """The text in a file: UTF-8 or UTF-16, else Shift-JIS, as dance programs of Japan write, else Latin-1; ValueError if none."""
    named = ENCODINGS.get(data[:2])
    for encoding in [named] if named else ["utf-8-sig", "cp932", "latin-1"]:
        try:
            text = data.decode(encoding).removeprefix("\ufeff")
            break
        except UnicodeDecodeError as error:
            if named:
                raise ValueError(f"it begins like {named}, but {error.reason} at byte {error.start}") from error
    if "\0" in text:
        raise ValueError("it holds zero bytes")
    return text


class _Lines:
    """The words of a file line by line, braces on lines of their own; remembers where it is."""

    def __init__(self, path: Path, text: str):
        self.path, self.number = path, 0
        self.words: list[str] = []
        self._rest = self._split(text)

    def _split(self, text: str) -> Iterator[tuple[int, list[str]]]:
        for self.last, line in enumerate(text.splitlines(), start=1):
            for part in re.split(r"([{}])", line):
                if part.strip():
                    yield self.last, part.split()

    def more(self) -> bool:
        """Go to the next line that is not empty; False at the end."""
        self.number, self.words = next(self._rest, (self.number, []))
        return bool(self.words)

    def take(self, expected: str) -> list[str]:
        """The words of the next line; `expected` says what must stand there."""
        if not self.more():
            raise StageError(f"{self.path} ends too soon", HINT, [f"after line {self.number}: expected {expected}"])
        return self.words

    def keyword(self, *words: str) -> list[str]:
        """What follows `words` on the next line, which must begin with them."""
        found = self.take(" ".join(words))
        if [word.lower() for word in found[: len(words)]] != [word.lower() for word in words]:
            raise self.refuse(" ".join(words))
        return found[len(words) :]

    def numbers(self, words: list[str], count: int, what: str) -> list[float]:
        """`words` as that many finite numbers."""
        if len(words) != count:
            raise self.refuse(f"{count} numbers ({what})", f"{len(words)} numbers")
        try:
            values = list(map(float, words))
        except ValueError as error:
            raise self.refuse(f"{count} numbers ({what})", str(error)) from error
        if not np.isfinite(values).all():
            raise self.refuse(f"finite numbers ({what})")
        return values

    def refuse(self, expected: str, found: str = "") -> StageError:
        """The error of this line."""
        line = " ".join(self.words)
        found = found or repr(line if len(line) < 60 else f"{line[:57]}...")
        return StageError(
            f"line {self.number} of {self.path} is not as in a BVH", HINT, [f"expected {expected}", f"found {found}"]
        )


class _Skeleton(NamedTuple):
    """What HIERARCHY says: names, parents, offsets and channels, one of each a joint."""

    names: list[str]
    parents: list[int]
    offsets: list[list[float]]
    channels: list[list[str]]


def _skeleton(lines: _Lines) -> _Skeleton:
    skeleton, open_ = _Skeleton([], [], [], []), [0]
    lines.keyword("HIERARCHY")
    _joint(lines, skeleton, -1, lines.keyword("ROOT"))
    while open_:
        words = lines.take("JOINT, End Site or a closing brace")
        kind = words[0].lower()
        if kind == "}":
            open_.pop()
        elif kind == "joint":
            _joint(lines, skeleton, open_[-1], words[1:])
            open_.append(len(skeleton.names) - 1)
        elif [word.lower() for word in words] == ["end", "site"]:
            _begin(lines, skeleton, open_[-1], "")
            skeleton.channels.append([])
            lines.keyword("}")
        else:
            raise lines.refuse(f"JOINT, End Site or a closing brace (of {skeleton.names[open_[-1]]})")
    return skeleton


def _joint(lines: _Lines, skeleton: _Skeleton, parent: int, words: list[str]) -> None:
    name = " ".join(words)
    if not name:
        raise lines.refuse("the name of a joint")
    if name in skeleton.names:
        raise lines.refuse("a name of its own for each joint", f"{name!r} twice")
    check_count(len(skeleton.names) + 1, "joints", f"the skeleton of {lines.path}", "leave out what is no body")
    check_count(len(name), "letters", f"a name in line {lines.number} of {lines.path}", "rename the joint")
    _begin(lines, skeleton, parent, name)
    count, *channels = lines.keyword("CHANNELS") or ["none"]
    known = {channel.lower(): channel for channel in CHANNELS}
    channels = [known.get(channel.lower(), channel) for channel in channels]
    unknown = [channel for channel in channels if channel not in CHANNELS]
    if unknown:
        raise lines.refuse(f"channels of {', '.join(CHANNELS)}", repr(unknown[0]))
    if count != str(len(channels)):
        raise lines.refuse("a count and as many channels", f"the count {count!r} and {len(channels)} channels")
    if len(set(channels)) != len(channels):
        raise lines.refuse("each channel once")
    skeleton.channels.append(channels)


def _begin(lines: _Lines, skeleton: _Skeleton, parent: int, name: str) -> None:
    lines.keyword("{")
    skeleton.names.append(name)
    skeleton.parents.append(parent)
    skeleton.offsets.append(lines.numbers(lines.keyword("OFFSET"), 3, "x y z"))


def _motion(lines: _Lines, width: int) -> tuple[float, np.ndarray, tuple[str, ...]]:
    """Frames a second, the numbers [F,width] of all frames, and what is to be said where these are not as many as promised."""
    lines.keyword("MOTION")
    words = lines.keyword("Frames:")
    if len(words) != 1 or not words[0].isdecimal() or len(words[0]) > DIGITS or int(words[0]) == 0:
        raise lines.refuse("a whole number of frames, at least 1")
    count = int(words[0])
    (seconds,) = lines.numbers(told := lines.keyword("Frame", "Time:"), 1, "seconds from frame to frame")
    if seconds <= 0:
        raise lines.refuse("a time above 0 s from frame to frame")
    rows: list[list[float]] = []
    while lines.more():
        rows.append(lines.numbers(lines.words, width, f"the channels of frame {len(rows)}"))
    if len(rows) < count - max(1, SHORT * count) or not rows:
        facts = [f"after line {lines.number}: {len(rows)} frames of {count}"]
        raise StageError(f"{lines.path} ends too soon", HINT, facts)
    said = () if len(rows) == count else (f"it says {count} frames and holds {len(rows)}: these are taken",)
    return usual_rate(told[0], seconds=True), np.array(rows).reshape(len(rows), width), said


def _bvh(skeleton: _Skeleton, fps: float, rows: np.ndarray, said: tuple[str, ...]) -> Bvh:
    places = np.tile(np.array(skeleton.offsets), (len(rows), 1, 1))
    rotations = np.tile(np.eye(3), (*places.shape[:2], 1, 1))
    first = 0
    for joint, channels in enumerate(skeleton.channels):
        values = dict(zip(channels, rows[:, first : first + len(channels)].T, strict=True))
        first += len(channels)
        for axis in "XYZ":
            if f"{axis}position" in values:
                places[:, joint, "XYZ".index(axis)] = values[f"{axis}position"]
        order = "".join(channel[0] for channel in channels if channel.endswith("rotation"))
        if order:  # the first one named turns last: R = R1 R2 R3
            angles = np.stack([values[f"{axis}rotation"] for axis in order], 1)
            rotations[:, joint] = Rotation.from_euler(order, angles, degrees=True).as_matrix()
    return Bvh(tuple(skeleton.names), np.array(skeleton.parents), places, rotations, fps, said)

"""A folder of pictures: which of its files are the clip's, in what order and how far apart in time, and what is left out."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.contract import StageError

PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
"""Of two files of one name the format that more have is taken, the first of these where as many have it."""
DIGITS = 30  # of a number in a name; a time in nanoseconds has 19, and Python refuses to read thousands
NEAR = 0.01  # of the number after which a camera begins again: how near to it, and to 0, its pictures lie
REGULAR = 0.8  # share of steps between numbers that are alike, from which on numbers are time
STRANGERS = 0.2  # share of the pictures that may have names of another kind and are left out
DEEP, LISTED = 3, 5  # folders below that are looked into; things that are named


@dataclass(frozen=True)
class Pictures:
    """`files` in the order in which they were taken, `steps` [N] of time from the first, one where nothing lacks; what to say."""

    files: list[Path]
    steps: np.ndarray
    notes: list[str]
    doubts: list[str]


def natural_order(path: Path) -> list:
    """Sort key that puts frame_9 before frame_10."""
    parts, digits = [], ""
    for letter in path.name.lower() + "\0":
        if letter.isdigit() and letter.isascii():
            digits += letter
            continue
        parts += [(0, int(digits), "")] if digits else []
        parts += [(1, 0, letter)]
        digits = ""
    return [*parts, path.name]


def number(name: str) -> int | None:
    """The last run of digits in a name, as a number; None for one that is too long to count anything."""
    digits = re.findall(r"[0-9]+", name)
    return int(digits[-1]) if digits and len(digits[-1]) <= DIGITS else None


def picture_files(folder: Path) -> list[Path]:
    """The clip's pictures in a folder, in the order in which they were taken."""
    return pictures_in(folder).files


def pictures_in(folder: Path) -> Pictures:
    """The clip's pictures in a folder; what goes with them (masks, thumbnails, second formats) is left out, and said.

    StageError for a folder without pictures, with the folders inside it that have some.
    """
    every = sorted((path for path in Path(folder).iterdir() if path.name[0] != "."), key=natural_order)
    shown = [path for path in every if path.suffix.lower() in PICTURES and path.is_file()]
    beside, twins = beside_pictures(shown), list[Path]()
    apart = set(beside)
    kinds = Counter(path.suffix.lower() for path in shown if path not in apart)
    known: dict[str, Path] = {}
    for path in sorted(shown, key=lambda path: (-kinds[path.suffix.lower()], PICTURES.index(path.suffix.lower()))):
        if path not in apart and known.setdefault(path.stem.lower(), path) != path:
            twins.append(path)
    apart |= set(twins)
    alone = [path for path in shown if path not in apart]
    usual = Counter(map(_series, alone)).most_common(1)
    odd = [path for path in alone if _series(path) != usual[0][0]]
    odd = odd if len(odd) < STRANGERS * len(alone) else []
    files, steps, doubts = _numbered([path for path in alone if path not in odd])
    said = (
        (beside, f"names of others and a word, as masks have: `--masks {folder}` takes such"),
        (twins, "a second format of others"),
        (odd, "names of another kind"),
        ([path for path in every if path.is_file() and path not in shown], "of formats that are not read"),
    )
    notes = [f"left out {len(some)} files, {why}: {', '.join(p.name for p in some[:2])}" for some, why in said if some]
    inner = _inside(Path(folder))
    if not files:
        hint = f"`hugs run {inner[0][0]}`" if inner else f"give a video, or a folder of {', '.join(PICTURES)} files"
        facts = [f"{path} has {count}" for path, count in inner[:LISTED]]
        raise StageError(f"no pictures in {folder}", hint, [*facts, *notes])
    notes += [f"not looked into: {path}, with {count} pictures" for path, count in inner[:LISTED]]
    return Pictures(files, steps, notes, doubts)


def beside_pictures(files: Sequence[Path]) -> list[Path]:
    """Files that have the name of another, with a number in it, and a word more: 01_mask.png, thumb-01.jpg beside 01.jpg."""
    names = {path.stem.lower() for path in files if number(path.stem) is not None}

    def adds(name: str, i: int) -> bool:
        after = name[:i] in names and re.fullmatch(r"[^0-9]+| ?\([0-9]+\)", name[i:]) is not None
        return after or (name[i:] in names and re.fullmatch(r"[^0-9]*[^0-9a-z]", name[:i]) is not None)

    return [path for path in files if any(adds(path.stem.lower(), i) for i in range(1, len(path.stem)))]


def _series(path: Path) -> str:
    return re.sub("[0-9]+", "#", path.stem.lower())


def _inside(folder: Path) -> list[tuple[Path, int]]:
    """Folders inside that have pictures, and how many; the fullest first."""
    found: Counter[Path] = Counter()
    open_ = [folder]
    for _ in range(DEEP):
        open_ = [one for place in open_ for one in sorted(place.iterdir()) if one.is_dir() and one.name[0] != "."]
        found.update({one: sum(path.suffix.lower() in PICTURES for path in one.iterdir()) for one in open_})
    return [(path, count) for path, count in found.most_common() if count]


def _numbered(files: list[Path]) -> tuple[list[Path], np.ndarray, list[str]]:
    """The files in the order of their numbers, counted on where a camera began again; their steps; what to say of them.

    Numbers are time where nearly all are one step apart.
    """
    plain, numbers = np.arange(len(files), dtype=np.float64), [number(path.stem) or 0 for path in files]
    if len(set(numbers)) < max(len(files), 3) or len(set(map(_series, files))) > 1:
        return files, plain, []
    counted, doubts = np.array(numbers, np.float64), []
    order = counted.argsort()
    last = 10 ** min(len(re.findall("[0-9]+", files[order[-1]].stem)[-1]), 4) - 1  # cameras count to 9999
    at = int(np.diff(counted[order]).argmax()) + 1
    low, high = counted[order[[0, -1]]]
    if (
        last >= 999
        and high <= last < high + NEAR * last
        and low < NEAR * last < last / 2 < np.diff(counted[order]).max()
    ):
        doubts = [f"the camera counted to {last} and began again: {files[order[at]].name} is taken to be the first"]
        counted[order[:at]] += last
        order = np.roll(order, -at)
    ways = np.diff(counted[order])
    usual = np.median(ways)
    if (ways == usual).mean() < REGULAR:
        return [files[i] for i in order], plain, doubts
    gaps = [(int(counted[order[i]] + usual), int(counted[order[i + 1]] - usual)) for i in np.flatnonzero(ways > usual)]
    named = [f"{a} to {b}" if b > a else f"{a}" for a, b in gaps[:LISTED]]
    if named:
        more = f" and {len(gaps) - LISTED} more gaps" if len(gaps) > LISTED else ""
        doubts.append(f"pictures lack: {', '.join(named)}{more}; time goes on there as the numbers do")
    return [files[i] for i in order], np.append(0, np.cumsum(ways / usual)), doubts

"""Masks made by other programs: pictures and .npy files in many encodings, joined to frames by name."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import read_npy
from stages.formats.images import read_pixels
from stages.formats.video import PICTURES, natural

SUFFIXES = (*PICTURES, ".npy")
LABELS = 32
"""Integer masks whose largest value is at most this are labels: 0 is background, everything else the person."""


def mask_files(folder: Path) -> list[Path]:
    """The mask files of a folder in natural order; StageError if there is no folder or nothing in it."""
    folder = Path(folder)
    if not folder.is_dir():
        raise StageError(f"no folder of masks at {folder}", "give the folder that holds one mask per frame")
    found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    if not found:
        raise StageError(f"no masks in {folder}", f"masks are {', '.join(SUFFIXES)} files, one per frame")
    return sorted(found, key=natural)


def stem(path: Path) -> str:
    """A mask's name without its suffixes, those of the picture it belongs to included (frame.jpg.png -> frame)."""
    name = path.name
    while Path(name).suffix.lower() in SUFFIXES:
        name = name[: -len(Path(name).suffix)]
    return name


def number(name: str) -> int | None:
    """The last run of digits in a name, as a number."""
    digits = re.findall(r"[0-9]+", name)
    return int(digits[-1]) if digits else None


def read_values(path: Path) -> tuple[np.ndarray, str]:
    """Read a mask's values [H,W] as stored, and the name of what holds them.

    A cut-out with alpha gives its alpha, colours their brightest channel. Raises StageError for damaged files, for
    arrays that are no picture and for values that are not finite.
    """
    kind = path.suffix.lower()[1:]
    if kind == "npy":
        array = read_array(path)
        return array, f"{kind} {array.dtype}"
    pixels = read_pixels(path)
    channels = pixels.shape[2]
    if channels in (2, 4) and pixels[..., -1].min() != pixels[..., -1].max():
        return pixels[..., -1], f"{kind} alpha {pixels.dtype}"
    if channels > 2:
        return pixels[..., :3].max(2), f"{kind} colour {pixels.dtype}"
    return pixels[..., 0], f"{kind} {pixels.dtype}"


def read_array(path: Path) -> np.ndarray:
    """Read a .npy mask [H,W] (axes of length 1 are dropped) of bool, integers or finite floats."""
    array = np.squeeze(read_npy(path, "save it by numpy.save"))
    if array.ndim != 2 or array.dtype.kind not in "buif" or array.size == 0:
        raise StageError(f"{path} is not a mask [H,W]", "save one mask a file", [f"it is {array.dtype} {array.shape}"])
    if not np.isfinite(array).all():
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise StageError(f"{path} has values that are not finite", "make the mask again", [f"first at {first}"])
    return array.astype(np.uint8) if array.dtype == bool else array


class ForeignMasks:
    """Masks of another program: what their values mean is decided over all files of a kind, then each can be read.

    Integers up to `LABELS`, and any two values, are labels (the lower one is background); other values are soft
    masks over the range of their type (floats: 0..1, or 0..255 if any is above 1).
    """

    def __init__(self, paths: list[Path]):
        self.levels: dict[str, np.ndarray] = {}
        self.counts: dict[str, int] = {}
        for path in paths:
            values, kind = read_values(path)
            self.levels[kind] = np.union1d(self.levels.get(kind, values[:0, 0]), values)
            self.counts[kind] = self.counts.get(kind, 0) + 1

    def is_labels(self, kind: str) -> bool:
        """True if masks of this kind hold labels."""
        levels = self.levels[kind]
        return len(levels) <= 2 or (levels.dtype.kind in "ui" and levels[-1] <= LABELS)

    def top(self, kind: str) -> float:
        """The value that means 'surely person' in soft masks of this kind."""
        levels = self.levels[kind]
        if levels.dtype == np.uint16:
            return 65535.0
        return 1.0 if levels.dtype.kind == "f" and levels[-1] <= 1 else 255.0

    def read(self, path: Path) -> np.ndarray:
        """The mask as uint8 [H,W], 255 = marked."""
        values, kind = read_values(path)
        if self.is_labels(kind):
            lowest = self.levels[kind][0] if len(self.levels[kind]) == 2 else 0
            return np.where(values > lowest, np.uint8(255), np.uint8(0))
        top = self.top(kind)
        return np.rint(values.clip(0, top) * (255.0 / top)).astype(np.uint8)

    def encodings(self) -> dict[str, int]:
        """What was found: encoding in words -> files."""
        words = {}
        for kind, count in self.counts.items():
            levels = self.levels[kind]
            values = " and ".join(f"{v:g}" for v in levels) if len(levels) < 3 else f"0..{levels[-1]:g}"
            words[f"{kind}, {'labels ' + values if self.is_labels(kind) else f'soft 0..{self.top(kind):g}'}"] = count
        return words

"""Reads mask files of other programs, pictures and .npy, and finds out what their values mean."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from stages.contract import StageError
from stages.formats.arrays import read_npy
from stages.formats.frame_names import ENDINGS
from stages.formats.images import read_pixels
from stages.formats.kinds import names_in
from stages.formats.pictures import natural_order

K = TypeVar("K")
LABELS = 32
"""Labels of one clip at most; pictures with more colours than this are no masks."""
UNMARKED = 127
"""Largest value of 8 bits that marks nothing in a soft mask: few integers that never exceed it are labels."""
PIECE = 1 << 20  # pixels counted at a time
COLOURED = 30
"""Levels between a pixel's channels from which it is coloured; JPEG makes grey ones differ by less."""


def mask_files(folder: Path) -> list[Path]:
    """The mask files of a folder in natural order; StageError if there is no folder or nothing in it."""
    folder = Path(folder)
    if not folder.is_dir():
        raise StageError(f"no folder of masks at {folder}", "give the folder that holds one mask per frame")
    found = [p for p in folder.iterdir() if p.suffix.lower() in ENDINGS and not p.name.startswith(".")]
    if not found:
        hint = f"masks are {', '.join(ENDINGS)} files, one per frame"
        raise StageError(f"no masks in {folder}", hint, [names_in(folder)])
    return sorted(found, key=natural_order)


def read_values(path: Path) -> tuple[np.ndarray, str]:
    """Read a mask's values [H,W] as stored, and the name of what holds them.

    A cut-out with alpha gives its alpha, a picture with a palette or with few colours an integer for each (the palette's
    own, or r g b as one number), grey its level. Raises StageError for damaged files, for arrays that are no picture,
    for values that are not finite and for pictures of many colours, which are no masks.
    """
    kind = path.suffix.lower()[1:]
    if kind == "npy":
        array = checked_values(np.squeeze(read_npy(path, "save it by numpy.save")), str(path))
        return array, f"{kind} {array.dtype}"
    pixels = read_pixels(path)
    channels = pixels.shape[2]
    if channels in (2, 4) and pixels[..., -1].min() != pixels[..., -1].max():
        return pixels[..., -1], f"{kind} alpha {pixels.dtype}"
    if channels <= 2:
        return pixels[..., 0], f"{kind} {pixels.dtype}"
    if pixels.dtype == np.uint8 and (np.ptp(pixels[..., :3], axis=2) > COLOURED).any():
        return color_ids(pixels[..., :3], path), f"{kind} colour ids"
    return pixels[..., :3].max(2), f"{kind} colour {pixels.dtype}"


def color_ids(pixels: np.ndarray, path: Path) -> np.ndarray:
    """An integer for each colour of uint8 [H,W,3]: its place in the file's palette, else red green blue as one number."""
    table = palette(path)
    packed = pixels.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    seen = np.zeros(1 << 24, bool)
    seen[packed] = True
    colours = np.flatnonzero(seen)
    if len(colours) > (LABELS if table is None else 256):
        hint = "give masks: white where the person is, or one colour for each person, saved as PNG"
        raise StageError(f"{path} is a picture, not a mask", hint, [f"it has {len(colours)} colours"])
    if table is None:
        return packed
    codes = table.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    place = {int(code): i for i, code in reversed(list(enumerate(codes)))}
    return np.array([place[int(c)] for c in colours], np.uint32)[np.searchsorted(colours, packed)]


def palette(path: Path) -> np.ndarray | None:
    """Colours uint8 [N,3] of a PNG with a palette, else None. Source: PNG specification, 11.2.2 PLTE."""
    data = Path(path).read_bytes()
    if data[:8] != b"\x89PNG\r\n\x1a\n" or data[25] != 3:
        return None
    at = 8
    while data[at + 4 : at + 8] != b"PLTE":
        at += 12 + int.from_bytes(data[at : at + 4])
    return np.frombuffer(data, np.uint8, int.from_bytes(data[at : at + 4]), at + 8).reshape(-1, 3)


def checked_values(array: np.ndarray, what: str) -> np.ndarray:
    """The array if it is one mask [H,W] of bool, integers or finite floats; bool becomes uint8."""
    if array.ndim != 2 or array.dtype.kind not in "buif" or array.size == 0:
        raise StageError(f"{what} is not a mask [H,W]", "save one mask a file", [f"it is {array.dtype} {array.shape}"])
    if not np.isfinite(array).all():
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise StageError(f"{what} has values that are not finite", "make the mask again", [f"first at {first}"])
    return array.astype(np.uint8) if array.dtype == bool else array


@dataclass
class Levels:
    """What values masks of one kind hold: the distinct ones, or None if they are many, their range, and where."""

    kind: str
    dtype: np.dtype
    few: np.ndarray | None
    lowest: float = np.inf
    highest: float = -np.inf
    files: int = 0
    areas: dict[int, list[float]] = field(default_factory=dict)
    """Value -> the share of the picture that it covers, in each file that has it."""
    together: dict[tuple[int, int], list[bool]] = field(default_factory=dict)
    """Two values above the lowest -> whether they touch, in each file that has both."""

    @property
    def labels(self) -> bool:
        """Whether the values are labels."""
        if self.few is None or len(self.few) <= 2:
            return self.few is not None
        wide = self.dtype.kind in "ui" and self.dtype.itemsize > 1 and self.highest != 65535
        return self.dtype.kind in "ui" and (self.highest <= UNMARKED or wide or self.kind.endswith("ids"))

    @property
    def top(self) -> float:
        """The value that means 'surely person' in soft masks."""
        if self.dtype == np.uint16:
            return 65535.0
        return 1.0 if self.dtype.kind == "f" and self.highest <= 1 else 255.0

    @property
    def background(self) -> float:
        """The label of the background."""
        return self.few[0] if self.few is not None and len(self.few) == 2 else min(0, self.lowest)

    def marked(self, values: np.ndarray, labels: frozenset[int] = frozenset()) -> np.ndarray:
        """Values [H,W] of this kind as uint8, 255 = marked; of label masks only `labels`, or all but the background."""
        if self.labels and labels:
            return np.where(np.isin(values, list(labels)), np.uint8(255), np.uint8(0))
        if self.labels or self.lowest < 0:
            return np.where(values > (self.background if self.labels else 0), np.uint8(255), np.uint8(0))
        return np.rint(values.clip(0, self.top) * (255.0 / self.top)).astype(np.uint8)

    def __str__(self) -> str:
        few, high = self.few, f"0..{self.highest:g}"
        values = " and ".join(f"{v:g}" for v in few) if few is not None and len(few) < 3 else high
        meaning = f"labels {values}" if self.labels else "logits" if self.lowest < 0 else f"soft 0..{self.top:g}"
        return f"{self.kind}, {meaning}"

    def add(self, values: np.ndarray) -> None:
        """Take one more mask into account."""
        self.files += 1
        found, counts = _distinct(values)
        self.lowest, self.highest = min(self.lowest, found[0]), max(self.highest, found[-1])
        if self.few is not None:
            joined = np.union1d(self.few, found)
            self.few = joined if len(joined) <= LABELS + 1 else None
        if self.few is None or values.dtype.kind == "f" or len(found) < 3:
            pairs: set[tuple[int, int]] = set()
        else:
            pairs = neighbours(values)
        if self.few is not None and values.dtype.kind != "f":
            labels = [int(value) for value in found]
            for label, count in zip(labels, counts, strict=True):
                self.areas.setdefault(label, []).append(count / values.size)
            for i, a in enumerate(labels):
                for b in labels[i + 1 :]:
                    self.together.setdefault((a, b), []).append((a, b) in pairs)


def _distinct(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different values in order, and how often each is there; bytes are counted, which is faster than sorting them."""
    if values.dtype != np.uint8:
        return np.unique(values, return_counts=True)
    line, counts = values.ravel(order="K"), np.zeros(256, np.int64)
    for start in range(0, len(line), PIECE):
        counts += np.bincount(line[start : start + PIECE], minlength=256)
    found = np.flatnonzero(counts)
    return found.astype(np.uint8), counts[found]


def neighbours(values: np.ndarray) -> set[tuple[int, int]]:
    """Pairs of different values (the smaller first) that stand side by side in [H,W]."""
    found = set()
    for a, b in ((values[:, 1:], values[:, :-1]), (values[1:], values[:-1])):
        differ = a != b
        both = np.sort(np.stack([a[differ], b[differ]], 1).astype(np.int64), axis=1)
        found |= {(int(low), int(high)) for low, high in np.unique(both, axis=0)}
    return found


def levels_of(keys: Iterable[K], values_of: Callable[[K], tuple[np.ndarray, str] | None]) -> dict[K, Levels]:
    """Of each mask of another program what its values mean, which is decided over all masks of a kind.

    Few integers up to `UNMARKED`, a few integers of 16 bits and more, colours, and any two values, are labels (the lowest is
    background). Floats below 0 are logits: the person is above 0. Other values are soft masks over the range of their
    type (floats: 0..1, or 0..255 if any is above 1). `values_of` reads the values of a key; keys that have none are left out.
    """
    found, kinds = dict[K, Levels](), dict[str, Levels]()
    for key in keys:
        if read := values_of(key):
            values, kind = read
            found[key] = kinds.setdefault(kind, Levels(kind, values.dtype, values[:0, 0]))
            found[key].add(values)
    return found

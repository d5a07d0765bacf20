"""Masks in COCO's .json: run lengths (compressed or not) or polygons, for each object of each picture.

{"images": [{"id", "file_name", "height", "width"}], "categories": [{"id", "name"}],
 "annotations": [{"image_id", "category_id", "segmentation", "track_id" or "instance_id" where there is one}]}

Run lengths count background and object in turn, down the columns. As text: 5 bits a letter (its code less 48),
lowest first, bit 32 if more follow, signed; from the fourth run on, the difference to the run two before.
Polygons are x y x y ... with the first pixel's corner at (0, 0); a pixel belongs to one if its centre does.
Source: https://cocodataset.org/#format-data and cocoapi, common/maskApi.c.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from stages.contract import StageError
from stages.formats.budget import Budget, check_count
from stages.formats.facts import Facts, read_facts
from stages.formats.frame_names import stem
from stages.formats.given_masks.mask_set import MaskSet, Values

HINT = "COCO masks need images with id, file_name, height, width, and annotations with image_id and segmentation"
TRACKS = ("track_id", "instance_id", "object_id", "obj_id")  # whichever all have
LARGEST = 1 << 14  # px a side
WORK = 1 << 36
"""Pixels of all masks of a file together; ten people for a minute of 1920x1080 at 30 a second have 37 thousand million."""
LETTERS = 6  # of a run length; LARGEST x LARGEST px fit
FAR = 1e6  # px: no corner of a polygon is so far from its picture
CROSSING = 64  # bytes that a row's crossing of a polygon's side takes
OVERLAP = 0.2  # intersection over union of boxes from which an object is the same as one seen before


class Picture(Facts):
    id: int | str
    file_name: str
    height: int = Field(gt=0, le=LARGEST)
    width: int = Field(gt=0, le=LARGEST)


class Category(Facts):
    id: int | str
    name: str


class Instance(Facts):
    """The mask of an object in a picture; of the ids by which it is tracked there may be one, of any name."""

    image_id: int | str
    segmentation: Any
    category_id: int | str | None = None
    track_id: int | str | None = None
    instance_id: int | str | None = None
    object_id: int | str | None = None
    obj_id: int | str | None = None


class Coco(Facts):
    images: tuple[Picture, ...] = Field(min_length=1)
    annotations: tuple[Instance, ...] = Field(min_length=1)
    categories: tuple[Category, ...] = ()


def read_coco(path: Path) -> MaskSet:
    """Read instances; only people, if a category is called person. StageError with the annotation that is wrong.

    Objects are told apart by a track id; without, they are followed from picture to picture by their boxes, in the order
    of the pictures' names. Parts of one object in one picture are joined.
    """
    content = read_facts(path, Coco, HINT)
    images = sorted({image.id: image for image in content.images}.values(), key=lambda image: stem(image.file_name))
    row = {image.id: i for i, image in enumerate(images)}
    shown: list[list[tuple[Instance, str]]] = [[] for _ in images]
    people, budget = {one.id for one in content.categories if one.name.lower() == "person"}, Budget(path, most=WORK)
    for i, one in enumerate(content.annotations):
        if people and one.category_id not in people:
            continue
        if one.image_id not in row:
            facts = [f"image_id is {str(one.image_id)[:60]}, {len(images)} images are there"]
            raise StageError(f"annotation {i} of {path} belongs to no image", HINT, facts)
        image = images[row[one.image_id]]
        budget.spend(image.height * image.width, f"the mask of annotation {i}, a byte a pixel,")
        shown[row[one.image_id]].append((one, f"annotation {i} of {path}"))
    every = [one for image in shown for one, _ in image]
    track = next((key for key in TRACKS if every and all(getattr(one, key) is not None for one in every)), None)
    parts: dict[str, dict[int, list[tuple[Any, str]]]] = defaultdict(lambda: defaultdict(list))
    tracker = BoxTracker()
    for i, (image, there) in enumerate(zip(images, shown)):
        found = [(one.segmentation, what) for one, what in there]
        if track:
            ids = [(str(getattr(one, track)), k) for k, (one, _) in enumerate(there)]
        else:
            ids = tracker.add([box_of(decode(part, image.height, image.width, what)) for part, what in found])
        for name, k in ids:
            parts[name][i].append(found[k])
    check_count(len(parts), "tracks", path, "leave out what is nobody")

    def read(person: str, i: int) -> Values | None:
        masks = [decode(part, images[i].height, images[i].width, what) for part, what in parts[person].get(i, ())]
        return (np.logical_or.reduce(masks).view(np.uint8), "COCO") if masks else None

    names = tuple(stem(image.file_name) for image in images)
    return MaskSet(f"COCO file of {len(parts)} objects", names, tuple(parts), read)


def decode(segmentation: object, height: int, width: int, what: str) -> np.ndarray:
    """The mask bool [height,width] of run lengths or polygons; StageError where they do not fit that size."""
    if isinstance(segmentation, list):
        return polygons(segmentation, height, width, what)
    given = segmentation if isinstance(segmentation, dict) else {}
    if missing := [key for key in ("counts", "size") if key not in given]:
        facts = [f"it holds {', '.join(given) or str(segmentation)[:60]}"]
        raise StageError(f"the segmentation of {what} has no {missing[0]}", HINT, facts)
    counts, size = given["counts"], given["size"]
    if size != [height, width]:
        raise StageError(f"the size of {what} is not its image's", HINT, [f"found {size}, wanted [{height}, {width}]"])
    runs = run_lengths(counts, what) if isinstance(counts, str) else counts
    if not isinstance(runs, list) or not all(isinstance(run, int) and run >= 0 for run in runs):
        found = [run for run in runs if not isinstance(run, int) or run < 0][:1] if isinstance(runs, list) else runs
        raise StageError(f"the counts of {what} are not run lengths", HINT, [f"found {str(found)[:60]}"])
    if sum(runs) != height * width:
        facts = [f"they come to {sum(runs)} pixels, wanted {height} x {width} = {height * width}"]
        raise StageError(f"the counts of {what} do not fill its image", HINT, facts)
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def run_lengths(text: str, what: str) -> list[int]:
    """Run lengths from COCO's text."""
    letters = np.frombuffer(text.encode("utf-32-le", "surrogatepass"), np.uint32).astype(np.int64) - 48
    wrong = np.flatnonzero((letters < 0) | (letters >= 64))
    if len(wrong):
        place = int(wrong[0])
        raise StageError(f"the counts of {what} are not COCO's text", HINT, [f"letter {place} is {text[place]!r}"])
    if not len(letters):
        return []
    if letters[-1] & 32:
        raise StageError(f"the counts of {what} are cut short", HINT, [f"{len(text)} letters, the last {text[-1]!r}"])
    ends = np.flatnonzero(letters & 32 == 0)
    starts = np.append(0, ends[:-1] + 1)
    counts = ends - starts + 1
    if counts.max() > LETTERS:
        facts = [f"one of them has {counts.max()} letters, {LETTERS} are enough for any picture"]
        raise StageError(f"the counts of {what} are not run lengths", HINT, facts)
    shifts = 5 * (np.arange(len(letters)) - np.repeat(starts, counts))
    runs = np.add.reduceat((letters & 31) << shifts, starts) - np.where(letters[ends] & 16, 1 << 5 * counts, 0)
    for first in (1, 2):  # each is a difference to the one two before
        runs[first::2] = runs[first::2].cumsum()
    return runs.tolist()


def polygons(parts: list, height: int, width: int, what: str) -> np.ndarray:
    """Pixels [height,width] whose centre lies in any of the polygons, each filled by the even-odd rule."""
    budget, begins, ends = Budget(what), [], []
    for part in parts:
        try:
            corners = np.array(part, np.float64).reshape(-1, 2)
        except (TypeError, ValueError) as error:
            raise StageError(f"{what} has a polygon that is not a list of x and y", HINT, [str(error)]) from error
        if len(corners) < 3 or not (np.abs(corners) < FAR).all():
            raise StageError(f"{what} has an invalid polygon", HINT, [f"{len(corners)} corners: {str(part)[:60]}"])
        crossings = _crossings(corners, height, width, budget)
        begins.append(crossings[0::2])
        ends.append(crossings[1::2])
    at = np.concatenate([*begins, *ends, [height * (width + 1)]]).astype(np.int64)
    step = np.repeat([1, -1, 0], [sum(map(len, begins)), sum(map(len, ends)), 1])
    order = at.argsort(kind="stable")
    inside = np.append(0, step[order].cumsum()[:-1]) > 0  # before each crossing, in any of the polygons
    lengths = np.diff(at[order], prepend=0)
    return np.repeat(inside, lengths).reshape(height, width + 1)[:, :-1]


def _crossings(corners: np.ndarray, height: int, width: int, budget: Budget) -> np.ndarray:
    """Sorted crossings of a polygon's sides and the rows' middles: row * (width + 1) + the first pixel behind."""
    x0, y0 = corners.T
    x1, y1 = np.roll(corners, -1, axis=0).T
    low, high = (np.clip(np.ceil(y - 0.5), 0, height).astype(int) for y in (np.minimum(y0, y1), np.maximum(y0, y1)))
    counts = high - low
    budget.spend(CROSSING * int(counts.sum()), f"a polygon of {len(corners)} corners")
    slope = np.divide(x1 - x0, y1 - y0, out=np.zeros(len(corners)), where=counts > 0)
    side = np.repeat(np.arange(len(corners)), counts)
    rows = np.arange(len(side)) - np.repeat(counts.cumsum() - counts, counts) + low[side]
    across = x0[side] + (rows + 0.5 - y0[side]) * slope[side]
    return np.sort(rows * (width + 1) + np.clip(np.ceil(across - 0.5), 0, width).astype(int))


class BoxTracker:
    """Gives each object an id, counted from 1; an object whose box overlaps an earlier one keeps that one's id."""

    def __init__(self) -> None:
        self.last: dict[str, np.ndarray] = {}

    def add(self, boxes: Sequence[np.ndarray]) -> list[tuple[str, int]]:
        """(id, place in `boxes`) of each object of the next picture, the largest box first; boxes are [4] as in `box_of`."""
        free, found = dict(self.last), []
        for place in sorted(range(len(boxes)), key=lambda place: -boxes[place][2:].prod()):
            box = boxes[place]
            best = max(free, key=lambda known: intersection_over_union(free[known], box), default="")
            if not best or intersection_over_union(free[best], box) < OVERLAP:
                best = str(len(self.last) + 1)
            free.pop(best, None)
            self.last[best] = box
            found.append((best, place))
        return found


def box_of(mask: np.ndarray) -> np.ndarray:
    """x, y, width, height in px of the marked pixels of [H,W]; zeros if there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return np.zeros(4)
    return np.array([columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1], np.float64)


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boxes x, y, width, height."""
    shared = (np.minimum(a[:2] + a[2:], b[:2] + b[2:]) - np.maximum(a[:2], b[:2])).clip(0).prod()
    return float(shared / max(a[2:].prod() + b[2:].prod() - shared, 1e-9))

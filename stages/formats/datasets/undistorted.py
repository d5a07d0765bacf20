"""images/, masks/ and landmarks.npz of the sfm stage: the frames as a pinhole camera would have taken them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from stages.formats.arrays import read_npz, write_npz
from stages.formats.images import read_image, read_mask, write_image, write_mask
from stages.formats.landmarks import read_landmarks, write_landmarks
from stages.formats.people import PEOPLE
from stages.records import SeenLandmarks

Grid = tuple[np.ndarray, np.ndarray]
HELD = 4  # grids of lenses that are kept: where each frame has its own, all would fill the memory
LANDMARKS, LENS = "landmarks.npz", "lens.npz"
KNOTS = 16  # px between the places of a grid that lens.npz keeps; between them a strong lens is straight to 0.1 px
STEPS = 30  # of the search for a point in the pinhole picture; a lens that doubles sizes takes 20 to 0.01 px


def opencv_grid(K: np.ndarray, distortion: np.ndarray, width: int, height: int) -> Grid:
    """Where to sample a picture of a lens with OpenCV's k1 k2 p1 p2 k3 so that a pinhole camera of the same K appears.

    `K` [3,3] px, first pixel centre at (0.5, 0.5); the grid is as in `write_undistorted`.
    """
    whole = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    return cv2.initUndistortRectifyMap(whole, distortion, None, whole, (width, height), cv2.CV_32FC1)


def write_undistorted(
    frames: Path, masks: Path, out: Path, names: list[str], grid_of: Callable[[str], Grid | None]
) -> Iterator[int]:
    """Write `names` from frames/images and masks/masks to `out`, sampled at `grid`, yielding how many are done.

    The masks of each of several people go along, and the landmarks of one. `grid_of` gives a frame's (x, y) [H,W] float32 as
    cv2.remap wants it: centre of the first pixel at (0, 0). None links the files unchanged. Colours are sampled bicubically,
    masks bilinearly; a sample outside the image takes its nearest pixel. lens.npz keeps the grids of lenses that bend.
    """
    people = [folder.relative_to(masks) for folder in sorted((masks / PEOPLE).glob("*/masks"))]
    for kind in (Path("images"), Path("masks"), *people):
        (out / kind).mkdir(parents=True)
    seen = read_landmarks(masks / LANDMARKS) if (masks / LANDMARKS).exists() else None

    kept: dict[str, np.ndarray] = {}

    def write(name: str) -> SeenLandmarks | None:
        grid, image = grid_of(name), Path("images", f"{name}.png")
        each = [folder / image.name for folder in (Path("masks"), *people)]
        if grid is None:
            link(frames / image, out / image)
            for mask in each:
                link(masks / mask, out / mask)
        else:
            kept[name] = np.stack([part[np.ix_(*map(_knots, part.shape))] for part in grid])
            sampled = cv2.remap(read_image(frames / image), *grid, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            write_image(out / image, sampled)
            for mask in each:
                person = cv2.remap(read_mask(masks / mask), *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                write_mask(out / mask, person)
        there = seen[name] if seen else None
        return there if there is None or grid is None else replace(there, xy=pinhole_points(there.xy, grid))

    landmarks = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, theirs in enumerate(pool.map(write, names), 1):
            landmarks.append(theirs)
            yield done
    if seen:
        write_landmarks(out / LANDMARKS, names, landmarks)
    if kept:
        bent = [name for name in names if name in kept]
        grids, which = np.unique(np.stack([kept[name] for name in bent]), axis=0, return_inverse=True)
        write_npz(out / LENS, {"names": np.array(bent, np.str_), "grids": grids, "which": which.ravel()})


def _knots(count: int) -> np.ndarray:
    """The places along a side of `count` px that lens.npz keeps."""
    return np.append(np.arange(0, count - 1, KNOTS), count - 1)


def _between_knots(kept: np.ndarray, width: int, height: int) -> Grid:
    """The grid of which lens.npz has `kept` [2,h,w]."""
    at = [np.interp(np.arange(n), _knots(n), np.arange(len(_knots(n)))).astype(np.float32) for n in (width, height)]
    columns, rows = np.meshgrid(*at)
    x, y = (cv2.remap(part, columns, rows, cv2.INTER_LINEAR) for part in kept)
    return x, y


def read_lenses(sfm: Path, width: int, height: int) -> Callable[[str], Grid | None]:
    """Of each frame the grid that `write_undistorted` sampled its picture at, None where no lens bends."""
    if not (sfm / LENS).exists():
        return lambda name: None
    arrays = read_npz(sfm / LENS, "run the sfm stage again: `hugs run VIDEO sfm --force`")
    which = dict(zip(map(str, arrays["names"]), map(int, arrays["which"]), strict=True))

    @lru_cache(HELD)
    def grid(place: int) -> Grid:
        return _between_knots(arrays["grids"][place], width, height)

    return lambda name: grid(which[name]) if name in which else None


def pinhole_points(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Where the pinhole picture sampled at `grid` shows `points` [N,2] px of the lens's picture; by x <- x + (point - grid(x)).

    Beyond its border a step of the one is taken for a step of the other.
    """
    height, width = grid[0].shape
    wanted = points - 0.5
    at = wanted
    for _ in range(STEPS):
        inner = at.clip(0, [width - 1, height - 1])
        at = inner + wanted - _sampled(inner, grid)
    return at + 0.5


def lens_points(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Where the lens's picture shows `points` [N,2] px of the pinhole picture sampled at `grid`."""
    height, width = grid[0].shape
    inner = (points - 0.5).clip(0, [width - 1, height - 1])
    return _sampled(inner, grid) + points - inner


def _sampled(places: np.ndarray, grid: Grid) -> np.ndarray:
    """What a grid holds at `places` [N,2], the first pixel's centre at (0, 0)."""
    columns, rows = places.astype(np.float32).T[..., None]
    return np.hstack([cv2.remap(part, columns, rows, cv2.INTER_LINEAR) for part in grid])


def link(source: Path, target: Path) -> None:
    """Hard link `source` as `target`, or copy it where the file system cannot link."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)

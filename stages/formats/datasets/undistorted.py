"""images/, masks/ and landmarks.npz of the sfm stage: the frames as a pinhole camera would have taken them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from stages.formats.images import read_image, read_mask, write_image, write_mask
from stages.formats.landmarks import read_landmarks, write_landmarks
from stages.formats.people import PEOPLE
from stages.records import SeenLandmarks

Grid = tuple[np.ndarray, np.ndarray]
HELD = 4  # grids of lenses that are kept: where each frame has its own, all would fill the memory
LANDMARKS = "landmarks.npz"
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
    masks bilinearly; a sample outside the image takes its nearest pixel.
    """
    people = [folder.relative_to(masks) for folder in sorted((masks / PEOPLE).glob("*/masks"))]
    for kind in (Path("images"), Path("masks"), *people):
        (out / kind).mkdir(parents=True)
    seen = read_landmarks(masks / LANDMARKS) if (masks / LANDMARKS).exists() else None

    def write(name: str) -> SeenLandmarks | None:
        grid, image = grid_of(name), Path("images", f"{name}.png")
        each = [folder / image.name for folder in (Path("masks"), *people)]
        if grid is None:
            link(frames / image, out / image)
            for mask in each:
                link(masks / mask, out / mask)
        else:
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


def pinhole_points(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Where the pinhole picture sampled at `grid` shows `points` [N,2] px of the lens's picture; by x <- x + (point - grid(x)).

    Beyond its border a step of the one is taken for a step of the other.
    """
    height, width = grid[0].shape
    wanted = points - 0.5
    at = wanted
    for _ in range(STEPS):
        inner = at.clip(0, [width - 1, height - 1])
        columns, rows = inner.astype(np.float32).T[..., None]
        sampled = np.hstack([cv2.remap(part, columns, rows, cv2.INTER_LINEAR) for part in grid])
        at = inner + wanted - sampled
    return at + 0.5


def link(source: Path, target: Path) -> None:
    """Hard link `source` as `target`, or copy it where the file system cannot link."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)

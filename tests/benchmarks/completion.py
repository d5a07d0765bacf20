"""How well a picture is completed where nobody stands: holes of a person's shape, cut where the clip shows the scene.

    python -m tests.benchmarks.completion work/clip/default [RESULTS ...] [--frames 3] [--json out.json]

The middle of the person's mask is moved to the side by one and two of its widths, both ways, and what lies there is completed, as
is the person's own place. dB are of the hole, LPIPS of the box around it; beside it OpenCV's inpainting by Telea.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from stages.avatar.measures.lpips import Lpips
from stages.avatar.measures.metrics import psnr
from stages.estimators.assets import fetch
from stages.formats.images import read_image, read_mask
from stages.training.finishing.completion import complete
from tests.benchmarks.host import tell

MIDDLE = 0.025  # of the person's height that their mask loses at its border: parallax shows the rest
AROUND = 24  # px around a hole
LEAST = 0.3  # of the middle, that has to lie in the picture and beside the person


def pretended(mask: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """For a person's mask [H,W]: holes to complete, theirs with one beside, and which part of them the picture shows."""
    person = cv2.dilate((mask > 127).astype(np.uint8), np.ones((9, 9))) > 0
    height = np.ptp(np.nonzero(mask > 127)[0]) if (mask > 127).any() else 0
    reach = 2 * int(MIDDLE * height) + 1
    middle = cv2.erode((mask > 127).astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    found, (rows, columns) = [], np.nonzero(middle)
    if not len(rows):
        return []
    width = int(max(np.quantile(columns, 0.9) - np.quantile(columns, 0.1), 0.2 * height))
    for moved in (-width, width, -2 * width, 2 * width):
        inside = (columns + moved >= 0) & (columns + moved < mask.shape[1])
        beside = np.zeros_like(person)
        beside[rows[inside], columns[inside] + moved] = True
        asked = beside & ~person
        if asked.sum() > LEAST * len(rows):
            found.append((beside | person, asked))
    return found


def telea(picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """The library's own inpainting."""
    grey_steps = (255 * picture).round().astype(np.uint8)
    return cv2.inpaint(grey_steps, hole.astype(np.uint8), 5, cv2.INPAINT_TELEA).astype(np.float32) / 255


def measure(results: Path, frames: int, lpips: Lpips) -> dict[str, object]:
    """dB and LPIPS of both ways, the mean over all holes of a clip."""
    names = sorted(path.stem for path in (results / "sfm" / "images").iterdir())
    chosen = [names[i] for i in np.linspace(0, len(names) - 1, frames + 2).astype(int)[1:-1]]
    rows: dict[str, list[tuple[float, float]]] = {"telea": [], "complete": []}
    for name in chosen:
        (image,) = (results / "sfm" / "images").glob(f"{name}.*")
        picture = read_image(image).astype(np.float32) / 255
        for hole, asked in pretended(read_mask(results / "sfm" / "masks" / f"{name}.png")):
            where = np.argwhere(asked)
            box = tuple(slice(max(0, a - AROUND), b + AROUND) for a, b in zip(where.min(0), where.max(0)))
            for way, fill in (("telea", telea), ("complete", complete)):
                filled = np.where(asked[..., None], fill(picture, hole), picture)
                pair = torch.as_tensor(filled), torch.as_tensor(picture)
                there = psnr(*(one[torch.as_tensor(asked)] for one in pair))
                rows[way].append((float(there), float(lpips(*(one[box].contiguous() for one in pair)))))
    means = {way: np.mean(found, 0) for way, found in rows.items()}
    return {"holes": len(rows["telea"])} | {way: {"psnr": m[0], "lpips": m[1]} for way, m in means.items()}


def main() -> None:
    """Print a row for each clip; write them as JSON too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    with np.load(fetch("lpips_alex.npz")) as arrays:
        lpips = Lpips(arrays)
    tell({str(one): measure(one, asked.frames, lpips) for one in asked.results}, asked.json)


if __name__ == "__main__":
    main()

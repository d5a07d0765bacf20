"""python -m tests.tools.strip work/kitchen/default docs/pictures/strip.webp: the pictures at the top of README.

Side by side, in four seconds: frames of the clip, the person from all sides, the person in a new motion, the empty scene.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import av
import cv2
import numpy as np

from stages.formats.images import read_image

PANELS, HEIGHT, GAP = (214, 246, 214, 214), 385, 4  # px; arms need room on the turntable
COUNT, SECONDS, QUALITY = 48, 4.0, 55


def main(pipeline: Path, out: Path) -> None:
    """Write the strip of a finished pipeline as an animated WebP."""
    clip = [read_image(path) for path in sorted((pipeline / "frames" / "images").iterdir())]
    films = [clip, *(read_film(pipeline / "render" / f"{name}.mp4") for name in ("turntable", "motion", "scene"))]
    panels = [
        [fit(pictures[i * len(pictures) // COUNT], width) for i in range(COUNT)]
        for pictures, width in zip(films, PANELS)
    ]
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    animation = cv2.Animation()
    animation.frames = [np.concatenate([a, gap, b, gap, c, gap, d], 1)[..., ::-1] for a, b, c, d in zip(*panels)]
    animation.durations = [round(1000 * SECONDS / COUNT)] * COUNT
    if not cv2.imwriteanimation(str(out), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        sys.exit(f"cannot write {out}")


def read_film(path: Path) -> Sequence[np.ndarray]:
    """All pictures of a video, uint8 [H,W,3]."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def fit(picture: np.ndarray, width: int) -> np.ndarray:
    """The middle of a picture uint8 [H,W,3], at the size of a panel."""
    height_in, width_in = picture.shape[:2]
    scale = min(height_in / HEIGHT, width_in / width)
    rows, columns = round(HEIGHT * scale), round(width * scale)
    top, left = (height_in - rows) // 2, (width_in - columns) // 2
    cut = np.ascontiguousarray(picture[top : top + rows, left : left + columns])
    return cv2.resize(cut, (width, HEIGHT), interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

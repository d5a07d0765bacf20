"""Clips of somebody before walls without corners, or with nothing but small or soft ones."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from stages.formats.images import write_image, write_mask
from tests.made.rooms import texture

WIDTH, HEIGHT, FRAMES = 320, 240, 12
STILL = np.zeros((FRAMES, 2))
SWAY = np.stack([2.5 * np.sin(1.3 * np.arange(FRAMES)), 2 * np.cos(2.1 * np.arange(FRAMES))], 1)
BUMP = np.where(np.arange(FRAMES)[:, None] < 8, 0, [7, -5])
PAN = np.arange(FRAMES)[:, None] * [3.0, 0.8]
CLOTH = texture(3)[..., 0].astype(np.float32)
Y, X = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
FLOOR = np.where(Y < 160, 120, 95).astype(np.float32)
DUST = FLOOR - 30 * ((X % 61 < 2) & (Y % 53 < 2))
DOOR = FLOOR - 35 * ((X > 30) & (X < 90) & (Y > 40) & (Y < 160)) + 40 * ((X > 240) & (X < 290) & (Y > 50) & (Y < 90))
SPOT = 80 + 90 * np.exp(-((X - 90) ** 2 + (Y - 90) ** 2) / 9000)
BLANK = np.full((HEIGHT, WIDTH), 110, np.float32)
DARK = 4 + 0.04 * FLOOR
DEFOCUSED = cv2.GaussianBlur(CLOTH[:HEIGHT, :WIDTH], (0, 0), 8)


def film_wall(
    folder: Path,
    wall: np.ndarray,
    way: np.ndarray = STILL,
    change: Callable[[np.ndarray, int], None] | None = None,
    zoom: np.ndarray | None = None,
) -> list[str]:
    """images/ and ignored/ (0 = not looked at) of a grey `wall`, moved by `way` [F,2] px after it is enlarged by `zoom` [F] about
    the middle, and then by `change`; with somebody before it, and noise. Returns the files' names."""
    rng, middle = np.random.default_rng(0), (np.array([WIDTH, HEIGHT]) - 1) / 2
    for kind in ("images", "ignored"):
        (folder / kind).mkdir(parents=True)
    for i, (step, scale) in enumerate(zip(way, np.ones(len(way)) if zoom is None else zoom, strict=True)):
        moved = np.column_stack([scale * np.eye(2), (1 - scale) * middle + step]).astype(np.float32)
        image = cv2.warpAffine(wall, moved, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
        if change:
            change(image, i)
        left = 130 + 3 * i
        image[60:220, left : left + 50] = 200 if i % 2 else 20  # somebody
        image = np.repeat(image[..., None], 3, 2) + rng.normal(0, 1.5, (HEIGHT, WIDTH, 3))
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[56:224, left - 4 : left + 54] = 0
        write_image(folder / f"images/{i:02d}.png", image.clip(0, 255).round().astype(np.uint8))
        write_mask(folder / f"ignored/{i:02d}.png", mask)
    return [f"{i:02d}.png" for i in range(len(way))]

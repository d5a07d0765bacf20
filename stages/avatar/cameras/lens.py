"""COLMAP's SIMPLE_RADIAL lens and the pinhole camera that replaces it.

Coordinates are normalised: (pixel - principal point) / focal. The lens moves a point u to u * (1 + k |u|^2).
Source: COLMAP src/colmap/sensor/models.h, SimpleRadialCameraModel.
"""

from __future__ import annotations

import numpy as np

NO_SHIFT = 0.1  # px: a lens that moves nothing farther is left alone; resampling would cost more than it mends


def distort(points: np.ndarray, k: float) -> np.ndarray:
    """Where the lens puts the ideal `points` [...,2]."""
    return points * (1 + k * (points**2).sum(-1, keepdims=True))


def undistort(points: np.ndarray, k: float) -> np.ndarray:
    """The inverse of `distort` for `points` [...,2], by Newton on the radius.

    Raises ValueError where the lens folds over itself (k < 0 and a radius that no ideal point reaches).
    """
    distorted = np.linalg.norm(points, axis=-1)
    if k < 0 and distorted.size and distorted.max() >= 2 / 3 / np.sqrt(-3 * k):
        raise ValueError(f"the lens with k = {k:.4g} folds over at radius {distorted.max():.3g}")
    radius = distorted.copy()
    for _ in range(20):
        radius = radius - (radius * (1 + k * radius**2) - distorted) / (1 + 3 * k * radius**2)
    return points * np.divide(radius, distorted, out=np.ones_like(radius), where=distorted > 0)[..., None]


def border(width: int, height: int, steps: int = 64) -> np.ndarray:
    """Points [4*steps,2] in px along the outline of an image, corners included."""
    x, y = np.linspace(0, width, steps), np.linspace(0, height, steps)
    sides = [(x, 0 * x), (x, 0 * x + height), (0 * y, y), (0 * y + width, y)]
    return np.concatenate([np.stack(side, 1) for side in sides])


def max_shift(focal: float, k: float, width: int, height: int) -> float:
    """The largest displacement in px that the lens causes inside the image, its diagonal at most."""
    u = (border(width, height) - [width / 2, height / 2]) / focal
    return min(float(np.linalg.norm(distort(u, k) - u, axis=1).max() * focal), float(np.hypot(width, height)))


def pinhole_focal(focal: float, center: np.ndarray, k: float, width: int, height: int) -> float:
    """The smallest focal length in px of a centred pinhole camera that sees nothing outside the lens's image.

    Width and height stay; `center` [2] is the lens's principal point. Raises ValueError for a lens that folds over.
    """
    return focal_within(undistort((border(width, height) - center) / focal, k), width, height)


def focal_within(outline: np.ndarray, width: int, height: int) -> float:
    """As `pinhole_focal`, for any lens: from the ideal points [4*steps,2] that it shows along `border`, at focal 1.

    Raises ValueError where no rectangle fits.
    """
    top, bottom, left, right = outline.reshape(4, -1, 2)
    room = min(
        -top[:, 1].max() / height, bottom[:, 1].min() / height, -left[:, 0].max() / width, right[:, 0].min() / width
    )
    if not room > 0:
        raise ValueError("the lens leaves no rectangle of the image")
    return 0.5 / room


def remap_grid(
    focal: float, center: np.ndarray, k: float, pinhole: float, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """For every pixel of the pinhole image, where to sample the lens's image: (x, y) [H,W] float32.

    In OpenCV's convention, the centre of the first pixel at (0, 0), as cv2.remap wants it; all else here counts
    from (0.5, 0.5), as COLMAP does.
    """
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    u = np.stack([x - width / 2, y - height / 2], -1) / pinhole
    source = distort(u, k) * focal + center - 0.5
    return source[..., 0].astype(np.float32), source[..., 1].astype(np.float32)

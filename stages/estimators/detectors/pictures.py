"""Brightness, samples and the background of single frames, for several detectors."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import map_coordinates


def brightness(image: np.ndarray) -> np.ndarray:
    """Grey values float32 [H,W] 0..255, softened."""
    return soften(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def soften(image: np.ndarray) -> np.ndarray:
    """A picture [H,W,...] in float32, a little blurred, so that a point's place need not be exact."""
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)


def background_mask(mask: np.ndarray) -> np.ndarray:
    """bool [H,W]: pixels that are surely not the person's."""
    reach = max(5, max(mask.shape) // 60) | 1
    return cv2.dilate(mask, np.ones((reach, reach), np.uint8)) <= 64


def sample(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Values float32 [N] of a one-channel `picture` float32 [H,W] at `pixels` [N,2], the first pixel's centre at (0.5, 0.5)."""
    return map_coordinates(picture, (pixels - 0.5).T[::-1], order=1, mode="nearest")

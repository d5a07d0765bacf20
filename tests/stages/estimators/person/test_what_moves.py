"""Masks of other frames lie beside what moves; those of the frames do not, whatever the camera does."""

import cv2
import numpy as np
import pytest

from stages.estimators.person.what_moves import lies_elsewhere

COUNT = 40
WALL = cv2.resize(np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8), None, fx=4, fy=4)


def clip(camera, still=False):
    """A square that walks to the right before a wall, and its masks."""
    images, masks = [], []
    for i in range(COUNT):
        x, y = {"stands": (20, 20), "slides": (20 + 2 * i, 20), "shakes": (20 + 5 * (i % 2), 20 + 3 * (i % 3))}[camera]
        image, mask = WALL[y : y + 120, x : x + 200].copy(), np.zeros((120, 200), np.uint8)
        at = 10 + (0 if still else 4 * i)
        image[40:100, at : at + 25], mask[40:100, at : at + 25] = (250, 240, 30), 255
        images.append(image)
        masks.append(mask)
    return images, masks


@pytest.mark.parametrize("camera", ["stands", "slides", "shakes"])
@pytest.mark.parametrize(("shift", "elsewhere"), [(0, False), (2, False), (20, True), (-15, True)])
def test_masks_of_other_frames_lie_beside_what_moves(camera, shift, elsewhere):
    images, masks = clip(camera)
    order = np.roll(np.arange(COUNT), shift).tolist()
    assert lies_elsewhere(COUNT, lambda i: images[i], lambda i: masks[order[i]]) == elsewhere


@pytest.mark.parametrize("camera", ["stands", "slides"])
def test_who_stands_still_is_not_doubted(camera):
    images, masks = clip(camera, still=True)
    assert not lies_elsewhere(COUNT, lambda i: images[i], lambda i: masks[i])
    assert not lies_elsewhere(1, lambda i: images[i], lambda i: masks[i])

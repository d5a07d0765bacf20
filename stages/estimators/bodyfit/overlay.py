"""Pictures of a fitted body: over frames with the edge of the mask, and from the side."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import cv2
import numpy as np

from stages.formats.images import evenly

if TYPE_CHECKING:
    from stages.formats.clip import Clip
    from stages.formats.facts import Smpl
    from stages.records import Ground

SHOWN = 6  # frames, at most, spread over the clip
DOUBTFUL = 3  # frames, at most, that are shown because their pose is doubtful
BLUE, ORANGE = (31, 111, 235), (255, 140, 0)


def draw_edge(image: np.ndarray, mask: np.ndarray) -> None:
    """Draw the edge of a mask uint8 [H,W] in orange into a picture uint8 [H,W,3]."""
    edges, _ = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, edges, -1, ORANGE, max(1, image.shape[0] // 400))


def overlays(clip: Clip, ground: Ground, fit: Smpl) -> Iterator[tuple[str, np.ndarray]]:
    """Names and pictures uint8 [H,W+H,3] of evenly spread frames, and doubtful ones: the posed body blue, the edge of the mask
    orange; beside it the body from the side.
    """
    from stages.avatar.cameras.pinhole import camera_centers
    from stages.avatar.kernels.mesh import covered
    from stages.estimators.bodyfit.posed import posed_bodies
    from stages.estimators.bodyfit.side_view import side_view

    doubtful = [name for name in clip.names if name in fit.doubtful]
    also = [clip.names.index(doubtful[i]) for i in evenly(len(doubtful), SHOWN)[:DOUBTFUL]]
    model, rows = clip.body_model, sorted({*evenly(len(clip.names), SHOWN), *also})
    for i, vertices in zip(rows, posed_bodies(model, clip.body, rows), strict=True):
        image = clip.images(i).copy()
        inside = covered(vertices, model.faces, clip.viewmats[i], clip.Ks[i], clip.width, clip.height)
        image[inside] = (0.6 * image[inside] + 0.4 * np.array(BLUE)).astype(np.uint8)
        draw_edge(image, clip.own_mask(i))
        expected = fit.expected_error_mm.get(clip.names[i])
        off = None if expected is None else np.array(expected.along) / 1000
        eye = camera_centers(clip.viewmats[i : i + 1])[0]
        beside = side_view(vertices, model.faces, model.J_regressor @ vertices, off, eye, ground, clip.height)
        yield clip.names[i], np.concatenate([image, beside], 1)

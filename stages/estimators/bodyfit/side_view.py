"""The fitted body from the side, on its floor: errors along the view, which no frame shows, are seen there."""

from __future__ import annotations

import cv2
import numpy as np

from stages.records import Ground

TALL, FLOOR = 2.4, 0.08  # m that the picture is high, and share of it below the floor
PAPER, SKIN, LINE, DOUBT = (250, 250, 250), (150, 185, 240), (90, 90, 90), (225, 110, 0)


def side_view(
    vertices: np.ndarray,
    faces: np.ndarray,
    joints: np.ndarray,
    expected: np.ndarray | None,
    eye: np.ndarray,
    ground: Ground,
    side: int,
) -> np.ndarray:
    """uint8 [side,side,3]: the body as seen square to the line of sight, the camera far to the left, level on its floor.

    `vertices` [V,3], `joints` [J,3] and the camera's place `eye` [3] in m in the ground's world, `faces` [T,3]; a bar through
    each joint is one `expected` [J] m long to either side, along the view. None: no bars.
    """
    middle = joints.mean(0)
    ahead = middle - eye
    ahead = ahead - (ahead @ ground.up) * ground.up
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    zoom = side / TALL
    axes = np.stack([ahead, -ground.up], 1) * zoom
    start = np.array([side / 2 - zoom * (middle @ ahead), side * (1 - FLOOR) + zoom * (ground.point @ ground.up)])

    def place(points: np.ndarray) -> np.ndarray:
        return np.rint((points @ axes + start) * 16).astype(np.int32)

    canvas = np.full((side, side, 3), PAPER, np.uint8)
    for triangle in place(vertices)[faces]:
        cv2.fillConvexPoly(canvas, triangle, SKIN, cv2.LINE_AA, 4)
    level = round(side * (1 - FLOOR))
    cv2.line(canvas, (0, level), (side, level), LINE, 1)
    for joint, error in zip(joints, np.zeros(len(joints)) if expected is None else expected, strict=True):
        ends = place(joint + np.array([[-error], [error]]) * ahead)
        cv2.line(canvas, ends[0].tolist(), ends[1].tolist(), DOUBT, max(2, side // 150), cv2.LINE_8, 4)
        cv2.circle(canvas, place(joint).tolist(), 16 * max(1, side // 150), LINE, -1, cv2.LINE_AA, 4)
    return canvas

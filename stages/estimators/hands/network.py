"""MediaPipe's hand network on LiteRT: 21 points of a hand in px and in metres, in a crop whose fingers point up.

The network is Google's (Zhang et al. 2020, "MediaPipe Hands: On-device Real-time Hand Tracking", arXiv:2006.10214); the code
around it is our own. A left hand is shown as its mirror image, so that the network and all after it know right hands only.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from ai_edge_litert.interpreter import Interpreter

from stages.estimators import assets
from stages.estimators.person.crops import Roi, crop, infer, to_axes, to_picture

CROP_SIDE = 224  # px, the network's own
POINTS = 21
KNUCKLES = (5, 9, 13, 17)
"""Points of the index, middle, ring and little finger where they leave the palm; point 0 is the wrist, 1 to 4 the thumb."""
PALM = (0, *KNUCKLES)
STIFF = (0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18)  # points that a crop is laid around: all but what waves
MARGIN, FORWARD = 2.0, 0.1  # a crop is so many times the size of those, and lies that share of them towards the fingers


@dataclass(frozen=True)
class SeenHand:
    """A hand as seen in one picture: `xy` [21,2] px; `world` [21,3] m about its middle, x right, y down, z away.

    `presence` is the probability that a hand is there, `side` that it is of the side that was looked for; `roi` its crop.
    """

    xy: np.ndarray
    world: np.ndarray
    presence: float
    side: float
    roi: Roi


class HandNetwork:
    """The landmark network; raises StageError if it has not been fetched."""

    def __init__(self, threads: int = 2):
        self.network = Interpreter(str(assets.path("hand_landmark_full.tflite")), num_threads=threads)
        self.network.allocate_tensors()

    def look(self, image: np.ndarray, roi: Roi, left: bool) -> SeenHand:
        """The hand in a crop of a picture uint8 [H,W,3]; `left`: a left one is looked for."""
        pixels = crop(image, roi, CROP_SIDE, cv2.BORDER_REPLICATE).astype(np.float32) / 255
        pixels = pixels[:, ::-1] if left else pixels
        points, presence, right, world = infer(self.network, pixels)
        spots, world = points.reshape(POINTS, 3)[:, :2] / CROP_SIDE, world.reshape(POINTS, 3).astype(np.float64)
        if left:
            spots, world = np.array([[1, 0]]) + spots * [-1, 1], world * [-1, 1, 1]
        return SeenHand(to_picture(spots, roi), to_axes(world, roi), float(presence[0]), float(right[0]), roi)

    def read(self, image: np.ndarray, roi: Roi, left: bool) -> SeenHand:
        """The hand near a crop: a first look finds it, a second one sees it in the crop that fits."""
        return self.look(image, around(self.look(image, roi, left).xy), left)


def around(xy: np.ndarray) -> Roi:
    """The crop that fits a hand with points `xy` [21,2] px, its fingers up."""
    dx, dy = (xy[5] + 2 * xy[9] + xy[13]) / 4 - xy[0]
    fitting = Roi.fitting(xy[list(STIFF)], float(np.arctan2(dx, -dy)))
    return fitting.reframe(shift=-FORWARD).reframe(MARGIN)

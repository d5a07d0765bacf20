"""MediaPipe's face network on LiteRT: does a crop show a face that nothing hides?

The network is Google's (Kartynnik et al. 2019, "Real-time Facial Surface Geometry from Monocular Video on Mobile GPUs",
arXiv:1907.06724); the code around it is our own. Its 468 points are not used.
"""

from __future__ import annotations

import cv2
import numpy as np
from ai_edge_litert.interpreter import Interpreter

from stages.estimators import assets
from stages.estimators.person.crops import Roi, crop, infer

CROP_SIDE = 192  # px, the network's own
MARGINS = 1.25, 1.75
"""Two crops, as shares of the face. The tight one misses the phone clip's mask, the wide one masks on drawn heads; of a face that
nothing hides it is sure in both."""


class FaceNetwork:
    """The landmark network; raises StageError if it has not been fetched."""

    def __init__(self, threads: int = 2):
        self.network = Interpreter(str(assets.path("face_landmark.tflite")), num_threads=threads)
        self.network.allocate_tensors()

    def presence(self, image: np.ndarray, face: Roi) -> float:
        """The probability of a face in a crop that just holds its brows and chin, of a picture uint8 [H,W,3]: the lesser of
        those in both margins."""
        return min(self._look(image, face.reframe(margin)) for margin in MARGINS)

    def _look(self, image: np.ndarray, roi: Roi) -> float:
        pixels = crop(image, roi, CROP_SIDE, cv2.BORDER_REPLICATE).astype(np.float32) / 255
        _, score = infer(self.network, pixels)
        return float(1 / (1 + np.exp(-score.item())))

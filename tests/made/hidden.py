"""Pictures of somebody whose face something hides, made of a picture that shows it, and of a face's points in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from stages.avatar.body.joints import HANDS
from stages.formats.body_model import read_body_model

BLUE, RED, BLACK, GREY = (150, 190, 215), (140, 40, 45), (15, 15, 18), (120, 120, 120)
MOUTH, EYES = (0.0, 0.55), (0.68, 0.92)  # of a face, from its chin to its brows
TALL = 0.172  # m from chin to brows


@dataclass(frozen=True)
class Face:
    """Points [N,2] px of a face in a picture, and how high [N] each is from its chin, 0, to its brows, 1."""

    xy: np.ndarray
    high: np.ndarray

    @property
    def tall(self) -> float:
        """px from chin to brows."""
        return float(np.ptp(self.xy[:, 1]))

    def part(self, of: tuple[float, float]) -> np.ndarray:
        """The points between two heights."""
        return self.xy[(self.high >= of[0]) & (self.high <= of[1])]


def covering(image: np.ndarray, points: np.ndarray, colour: tuple[int, ...]) -> np.ndarray:
    """The picture with the hull of points [N,2] px in a colour."""
    hull = cv2.convexHull(np.rint(16 * points).astype(np.int32))
    return cv2.fillConvexPoly(image.copy(), hull, colour, cv2.LINE_AA, 4)


def blurring(sigma: float) -> Callable[[np.ndarray, Face], np.ndarray]:
    """Blurs the picture by so many heights of the face."""
    return lambda image, face: cv2.GaussianBlur(image, (0, 0), sigma * face.tall)


def darkening(share: float) -> Callable[[np.ndarray, Face], np.ndarray]:
    """Leaves so much of the light."""
    return lambda image, face: (share * image).astype(np.uint8)


def pixelating(image: np.ndarray, face: Face) -> np.ndarray:
    """The picture in squares, eight to a face."""
    few = [max(1, round(8 * side / face.tall)) for side in image.shape[1::-1]]
    return cv2.resize(
        cv2.resize(image, few, interpolation=cv2.INTER_AREA), image.shape[1::-1], interpolation=cv2.INTER_NEAREST
    )


def boxing(image: np.ndarray, face: Face) -> np.ndarray:
    """A grey box over the face."""
    low, high = (np.rint(edge).astype(int).tolist() for edge in (face.xy.min(0), face.xy.max(0)))
    return cv2.rectangle(image.copy(), low, high, GREY, -1)


def with_glasses(image: np.ndarray, face: Face) -> np.ndarray:
    """Dark glasses."""
    return covering(image, face.part(EYES), BLACK)


def with_mask(image: np.ndarray, face: Face) -> np.ndarray:
    """A mask over mouth and nose."""
    return covering(image, face.part(MOUTH), BLUE)


def with_scarf(image: np.ndarray, face: Face) -> np.ndarray:
    """Dark glasses, and a scarf over mouth and nose."""
    return covering(with_glasses(image, face), face.part(MOUTH), RED)


def with_hand(image: np.ndarray, face: Face) -> np.ndarray:
    """A hand's shape of the face's own colour before it, fingers up."""
    corners = face.xy.mean(0) + hand() * face.tall / TALL
    colour = np.median(image[tuple(np.rint(face.xy).astype(int).T[::-1])], 0).tolist()
    covered = image.copy()
    for triangle in np.rint(16 * corners).astype(np.int32):
        cv2.fillConvexPoly(covered, triangle, colour, cv2.LINE_AA, 4)
    return covered


@cache
def hand() -> np.ndarray:
    """Triangles [T,3,2] m of the free body's hand from above, fingers up in a picture, about its middle."""
    model = read_body_model()
    own = model.lbs_weights[:, HANDS[0]] > 0.5
    corners = model.v_template[model.faces[own[model.faces].all(1)]]
    flat = np.stack([corners[..., 2], -corners[..., 0]], -1)
    return flat - (flat.min((0, 1)) + flat.max((0, 1))) / 2


HIDING: dict[str, Callable[[np.ndarray, Face], np.ndarray]] = {
    "mask": with_mask,
    "glasses and scarf": with_scarf,
    "box": boxing,
    "hand": with_hand,
    "blur": blurring(0.08),
    "squares": pixelating,
    "dark": darkening(0.02),
}
"""What hides a face from the network."""
BARE: dict[str, Callable[[np.ndarray, Face], np.ndarray]] = {
    "nothing": lambda image, face: image,
    "glasses": with_glasses,
    "soft": blurring(0.02),
    "dim": darkening(0.1),
}
"""And what does not."""

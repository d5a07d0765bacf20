"""Square crops of a picture, as the networks look at a person, and what they answer."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from ai_edge_litert.interpreter import Interpreter

ROI_MARGIN = 1.25  # the person's circle is enlarged by this to make a crop
APART = 0.3  # of a crop's side: people whose crops' centres are nearer are the same


@dataclass(frozen=True)
class Roi:
    """A square of the picture: centre in px, side in px, and the turn of its up direction in radians (clockwise)."""

    x: float
    y: float
    side: float
    angle: float

    def matrix(self) -> np.ndarray:
        """[2,3] taking crop coordinates in 0..1 to picture px."""
        c, s = np.cos(self.angle) * self.side, np.sin(self.angle) * self.side
        return np.array([[c, -s, self.x - (c - s) / 2], [s, c, self.y - (s + c) / 2]])

    def reframe(self, side: float = 1.0, turn: float = 0.0, shift: float = 0.0) -> Roi:
        """A crop of `side` times the size, turned by degrees, moved down the body by `shift` of the old side."""
        reach = shift * self.side
        x, y = self.x - reach * np.sin(self.angle), self.y + reach * np.cos(self.angle)
        return Roi(x, y, self.side * side, self.angle + np.radians(turn))

    def covers(self, other: Roi) -> bool:
        """True if the other crop's centre is so near that it shows the same person."""
        return bool(np.hypot(self.x - other.x, self.y - other.y) <= APART * self.side)

    def resembles(self, other: Roi, slack: float, turn: float) -> bool:
        """True if centre and side differ by at most `slack` of the side, and up by at most `turn` rad."""
        apart = max(np.hypot(self.x - other.x, self.y - other.y), abs(self.side - other.side)) / self.side
        turned = (other.angle - self.angle + np.pi) % (2 * np.pi) - np.pi
        return bool(apart <= slack and abs(turned) <= turn)

    @staticmethod
    def around(center: np.ndarray, top: np.ndarray) -> Roi:
        """The crop of a person whose circle has this centre and reaches to `top`; `top` points up in the crop."""
        dx, dy = top - center
        side = 2 * float(np.hypot(dx, dy)) * ROI_MARGIN
        return Roi(float(center[0]), float(center[1]), side, float(np.arctan2(dx, -dy)))

    @staticmethod
    def fitting(points: np.ndarray, angle: float) -> Roi:
        """The crop whose up is turned by `angle` rad and that just holds points [N,2] px."""
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])  # from the crop's axes
        upright = points @ turn
        x, y = (turn @ (upright.max(0) + upright.min(0)) / 2).tolist()
        return Roi(x, y, float(np.ptp(upright, axis=0).max()), angle)


def crop(image: np.ndarray, roi: Roi, side: int, border: int) -> np.ndarray:
    """Cut a Roi out as [side,side,3], first shrunk by area means so that nothing aliases."""
    factor = max(1, int(roi.side / side))
    height, width = image.shape[:2]
    if factor > 1:
        image = cv2.resize(image, (-(-width // factor), -(-height // factor)), interpolation=cv2.INTER_AREA)
    scale = np.array([[image.shape[1] / width], [image.shape[0] / height]])
    matrix = roi.matrix() * scale
    matrix[:, :2] /= side
    matrix[:, 2] += matrix[:, :2].sum(1) / 2 - 0.5  # cv2 counts pixel centres at whole numbers
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, matrix, (side, side), flags=flags, borderMode=border)


def to_picture(points: np.ndarray, roi: Roi) -> np.ndarray:
    """Take points [N,2] in 0..1 of a crop to picture px."""
    matrix = roi.matrix()
    return points @ matrix[:, :2].T + matrix[:, 2]


def to_axes(points: np.ndarray, roi: Roi) -> np.ndarray:
    """Turn points [N,3] about their middle from the axes of a crop into those of the picture."""
    c, s = np.cos(roi.angle), np.sin(roi.angle)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def infer(network: Interpreter, pixels: np.ndarray) -> list[np.ndarray]:
    """Run one picture [H,W,3] through a network and give its outputs in the order of their names."""
    network.set_tensor(network.get_input_details()[0]["index"], np.ascontiguousarray(pixels[None], np.float32))
    network.invoke()
    return [network.get_tensor(output["index"])[0] for output in network.get_output_details()]

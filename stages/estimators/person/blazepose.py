"""BlazePose on LiteRT: finds one person in each frame of a clip and gives joints in px and in metres, and an outline.

The two networks are Google's (Bazarevsky et al. 2020, "BlazePose: On-device Real-time Body Pose Tracking",
arXiv:2006.10204); the code around them is our own. Pixel coordinates have the first pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from ai_edge_litert.interpreter import Interpreter

from stages.estimators import assets
from stages.estimators.person.crops import Roi, crop, infer, to_axes, to_picture
from stages.formats.images import evenly
from stages.formats.landmarks import COUNT, MIRRORED, NAMES
from stages.records import SeenLandmarks

DETECTOR_SIDE, CROP_SIDE, HEATMAP_SIDE = 224, 256, 64  # px, the networks' own
SURE = 0.5  # probability from which a detection, a tracked person or a heat map counts
NEIGHBOURHOOD = 3  # heat map cells on each side of the peak that take part in its mean
PAINTED = 0.1  # of a person's height: how far beyond the joints a person is painted over
SEEDS = 9  # frames in which the person to follow is looked for
# Looks at the person that are averaged: (side as a share of the fitting crop, turn in degrees, mirrored). Measured on the
# kitchen clip, five looks halve the jitter of one (second difference 2.4 -> 1.2 px, 19 -> 10 mm).
LOOKS = ((1.0, 0, False), (0.9, 8, False), (0.9, -8, True), (1.1, 4, True), (1.1, -4, False))
SLACK, TURN = 0.15, np.radians(15)  # of a crop's side, and rad: crops that differ by more show the person differently
WIDER = 1.6  # times the side of a person's crop in which they are detected again
BETTER = 0.005  # by which the probability of a person must grow to leave the crop that the frames before led to
STRAY = 0.03  # share of the crop's side by which one look's landmark may differ from the middle one to be averaged

TORSO = [NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("shoulder", "hip")]
ROWS_MIRRORED = [*MIRRORED, *range(COUNT, COUNT + 6)]
"""The network's rows with left and right exchanged; its last six are about the whole person."""


class Images(Protocol):
    """Frames uint8 [H,W,3] in order of time: a list, or what reads each one when it is needed."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> np.ndarray: ...


@dataclass(frozen=True)
class Pose(SeenLandmarks):
    """The person as seen in one frame."""

    presence: float
    """Probability that a person is in the crop."""
    roi: Roi
    """The crop in which the person was seen."""
    next_roi: Roi
    """The crop that fits the person as seen."""


@dataclass(frozen=True)
class Sighting:
    """Somebody in one frame: the detector's probability and crop, and the pose in it."""

    frame: int
    score: float
    roi: Roi
    pose: Pose


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Logistic function without overflow."""
    return 0.5 * (1 + np.tanh(0.5 * np.asarray(x, np.float32)))


def anchors() -> np.ndarray:
    """Centres [2254,2] in 0..1 of the detector's 28x28x2, 14x14x2 and 7x7x6 boxes."""
    grids = []
    for cells, each in ((28, 2), (14, 2), (7, 6)):
        y, x = np.divmod(np.arange(cells * cells), cells)
        grids.append(np.repeat(np.stack([x + 0.5, y + 0.5], 1) / cells, each, 0))
    return np.concatenate(grids)


class BlazePose:
    """The detector and the landmark network; raises StageError if they have not been fetched."""

    def __init__(self, threads: int = 2):
        self.detector, self.landmarker = (
            Interpreter(str(assets.path(name)), num_threads=threads)
            for name in ("pose_detection.tflite", "pose_landmark_full.tflite")
        )
        for network in (self.detector, self.landmarker):
            network.allocate_tensors()
        self.anchors = anchors()

    def detect(self, image: np.ndarray, window: Roi | None = None, sure: float = SURE) -> list[tuple[float, Roi]]:
        """People in a window of the picture (default all of it): (probability, crop), best first, one per person.

        `sure` is the least probability.
        """
        height, width = image.shape[:2]
        window = window or Roi(width / 2, height / 2, float(max(width, height)), 0.0)
        pixels = crop(image, window, DETECTOR_SIDE, cv2.BORDER_CONSTANT).astype(np.float32)
        boxes, logits = infer(self.detector, pixels / 127.5 - 1)
        scores = sigmoid(logits.reshape(-1))
        found: list[tuple[float, Roi]] = []
        for i in np.argsort(-scores):
            if scores[i] < sure:
                break
            points = boxes.reshape(-1, 12)[i, 4:8].reshape(2, 2) / DETECTOR_SIDE + self.anchors[i]
            roi = Roi.around(*to_picture(points, window))
            if not any(r.covers(roi) for _, r in found):
                found.append((float(scores[i]), roi))
        return found

    def search(self, image: np.ndarray) -> list[tuple[float, Roi]]:
        """People in the picture: looks at all of it, then, if nobody is found, at parts of it, then turned."""
        height, width = image.shape[:2]
        found = self.detect(image)
        turned = [[Roi(width / 2, height / 2, float(max(width, height)), turn * np.pi)] for turn in (0.5, -0.5, 1.0)]
        for places in (*(squares(height, width, part) for part in (1.0, 0.6)), *turned):
            found = found or [hit for place in places for hit in self.detect(image, place)]
        return sorted(found, key=lambda hit: -hit[0])

    def look(self, image: np.ndarray, roi: Roi, mirrored: bool = False) -> tuple[Pose, np.ndarray]:
        """Read the person in a crop: the pose, and the outline's logits [256,256] in the crop.

        `mirrored`: show the network the crop's mirror image; the answer is for the crop as it is.
        """
        pixels = crop(image, roi, CROP_SIDE, cv2.BORDER_REPLICATE).astype(np.float32)
        points, presence, mask, heat, world = infer(self.landmarker, (pixels[:, ::-1] if mirrored else pixels) / 255)
        points = points.reshape(-1, 5)
        spots = refine(points[:, :2] / CROP_SIDE, sigmoid(heat.reshape(HEATMAP_SIDE, HEATMAP_SIDE, -1)))
        world, mask = world.reshape(-1, 3), mask.reshape(CROP_SIDE, CROP_SIDE)
        if mirrored:
            spots, points, world = (
                spots[ROWS_MIRRORED],
                points[ROWS_MIRRORED],
                world[ROWS_MIRRORED] * np.array([-1, 1, 1]),
            )
            spots[:, 0] = 1 - spots[:, 0]
            mask = mask[:, ::-1]
        xy = to_picture(spots, roi)
        turned = to_axes(world[:COUNT], roi)
        pose = Pose(
            xy[:COUNT],
            sigmoid(points[:COUNT, 3]) * sigmoid(points[:COUNT, 4]),
            turned,
            float(presence.reshape(())),
            roi,
            Roi.around(xy[COUNT], xy[COUNT + 1]),
        )
        return pose, mask

    def average_looks(self, image: np.ndarray, roi: Roi) -> Pose | None:
        """The mean of several looks, leaving out outliers (swapped sides, say); None if most looks see nobody."""
        poses = [self.look(image, roi.reframe(side, turn), mirrored)[0] for side, turn, mirrored in LOOKS]
        poses = [pose for pose in poses if pose.presence >= SURE]
        if 2 * len(poses) <= len(LOOKS):
            return None
        xy = np.stack([pose.xy for pose in poses])
        far = np.linalg.norm(xy - np.median(xy, 0), axis=2)
        kept = (far <= np.maximum(STRAY * roi.side, far.min(0))).astype(np.float64)
        mean = {
            name: np.einsum("pn,pn...->n...", kept / kept.sum(0), np.stack([getattr(pose, name) for pose in poses]))
            for name in ("xy", "visibility", "world")
        }
        circles = np.stack([[pose.next_roi.x, pose.next_roi.y, pose.next_roi.side] for pose in poses])
        up = np.mean([np.exp(1j * pose.next_roi.angle) for pose in poses])
        x, y, side = np.median(circles, 0).tolist()
        next_roi = Roi(x, y, side, float(np.angle(up)))
        return Pose(**mean, presence=float(np.mean([p.presence for p in poses])), roi=roi, next_roi=next_roi)

    def read(self, image: np.ndarray, roi: Roi) -> Pose | None:
        """The pose of the person in a crop, by several looks at the crop that fits; None if nobody is surely there."""
        first, _ = self.look(image, roi)
        return self.average_looks(image, first.next_roi) if first.presence >= SURE else None

    def follow(self, image: np.ndarray, last: Roi) -> Pose | None:
        """The pose of the person who was last seen at a crop; who is not there is looked for everywhere. None if not found."""
        pose = self.read(image, last)
        if pose is None:
            hits = [roi for _, roi in self.search(image)]
            nearest = min(hits, key=lambda roi: np.hypot(roi.x - last.x, roi.y - last.y), default=None)
            pose = self.read(image, nearest) if nearest else None
        return self.unstuck(image, pose) if pose else None

    def unstuck(self, image: np.ndarray, pose: Pose) -> Pose:
        """The pose, or that in the detector's crop where the person is surer there.

        Somebody who bends is followed into a crop of the trunk, which leads to the next, and stays one when they rise.
        """
        around = pose.next_roi
        for _, roi in self.detect(image, Roi(around.x, around.y, WIDER * around.side, 0.0)):
            if around.covers(roi) and not around.resembles(roi, SLACK, TURN):
                other = self.read(image, roi)
                if other is not None and other.presence > pose.presence + BETTER:
                    return other
        return pose

    def sightings(self, images: Images, among: Sequence[int] | None = None, most: int = SEEDS) -> list[Sighting]:
        """Everybody who is surely seen in a few frames, each frame's people from large to small.

        Looked at are at most `most` frames, spread over those in `among` (None: all).
        """
        found = []
        rows = np.arange(len(images)) if among is None else np.asarray(among, int)
        for i in rows[evenly(len(rows), most)]:
            image = images[i]
            here: list[Sighting] = []
            hits = self.search(image)
            while hits:
                known = len(here)
                for score, roi in hits:
                    pose, _ = self.look(images[i], roi)
                    if pose.presence >= SURE and not any(one.pose.next_roi.covers(pose.next_roi) for one in here):
                        here.append(Sighting(int(i), score, roi, pose))
                image = paint_over(image, here[known:])
                hits = self.detect(image) if len(here) > known else []
            found += sorted(here, key=lambda one: -one.pose.next_roi.side)
        return found

    def track(self, images: Images, start: Sighting | None = None) -> list[Pose | None]:
        """Follow one person through a clip's frames (uint8 [H,W,3] in order of time), both ways from `start`.

        Without a `start` it is the largest who is surely seen. A frame where the person cannot be found gives None; after
        it they are looked for again, nearest to where they were.
        """
        count = len(images)
        poses: list[Pose | None] = [None] * count
        start = start or pick_clearest(self.sightings(images))
        if start is None:
            return poses
        for order in (range(start.frame, count), range(start.frame - 1, -1, -1)):
            first = poses[start.frame]
            last = first.next_roi if first else start.roi
            for i in order:
                pose = poses[i] = self.follow(images[i], last)
                last = pose.next_roi if pose else last
        return poses


def squares(height: int, width: int, part: float) -> list[Roi]:
    """Crops of `part` of the picture's shorter side, which lap over each other and cover it."""
    side = part * min(height, width)
    across, down = (
        np.linspace(side / 2, length - side / 2, 1 + int(np.ceil(1.5 * (length / side - 1)))).tolist()
        for length in (width, height)
    )
    return [Roi(x, y, side, 0.0) for x in across for y in down]


def paint_over(image: np.ndarray, people: list[Sighting]) -> np.ndarray:
    """The picture with `people` painted over: the detector is made for one person and finds others once that one is gone."""
    painted = image.copy()
    for one in people:
        (left, top), (right, bottom) = one.pose.xy.min(0), one.pose.xy.max(0)
        rim = PAINTED * max(right - left, bottom - top)
        corners = np.array([left - rim, top - rim, right + rim, bottom + rim]).clip(0).astype(int)
        painted[corners[1] : corners[3], corners[0] : corners[2]] = 128
    return painted


def pick_clearest(sightings: list[Sighting]) -> Sighting | None:
    """The largest person who is surely seen."""
    return max(sightings, key=lambda one: one.score * one.roi.side, default=None)


def pick_masked(sightings: list[Sighting], masks: Sequence[np.ndarray]) -> Sighting | None:
    """The largest of those whose torso the `masks` (uint8 [H,W], 255 = person) of their frames cover, or of all."""
    covered = [one for one in sightings if torso_share(one.pose, masks[one.frame]) > 0.5]
    return pick_clearest(covered or sightings)


def torso_share(pose: Pose, mask: np.ndarray) -> float:
    """Share of the shoulders and hips that fall on a mask uint8 [H,W]."""
    x, y = pose.xy[TORSO].astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
    return float((mask[y[inside], x[inside]] > 127).sum() / len(TORSO))


def refine(points: np.ndarray, heat: np.ndarray) -> np.ndarray:
    """Move points [N,2] in 0..1 to the mean of their heat map [S,S,N] near them where its peak is sure."""
    refined = points.copy()
    side = heat.shape[0]
    for i, (x, y) in enumerate((points * side).astype(int)):
        x0, x1 = max(x - NEIGHBOURHOOD, 0), min(x + NEIGHBOURHOOD + 1, side)
        y0, y1 = max(y - NEIGHBOURHOOD, 0), min(y + NEIGHBOURHOOD + 1, side)
        if x0 >= x1 or y0 >= y1:
            continue
        near = heat[y0:y1, x0:x1, i]
        if near.max() >= SURE:
            refined[i] = (near.sum(0) @ np.arange(x0, x1), near.sum(1) @ np.arange(y0, y1)) / near.sum() / side
    return refined

"""Everybody in view of a clip, looked for in a few of its frames, also those who are small, or beside somebody larger."""

from __future__ import annotations

import cv2
import numpy as np

from stages.contract import Job
from stages.estimators.person.blazepose import SEEDS, BlazePose, Images, Pose, Sighting, sigmoid, squares, torso_share
from stages.estimators.person.crops import Roi
from stages.estimators.person.outline import paste
from stages.estimators.person.people import describe_place
from stages.formats.images import evenly

PAINT = 128  # grey of those who are painted over
FAINT, RIM = 0.2, 0.03  # probability, and share of the crop's side around it, from which a pixel is painted over
MOST = 6  # people that are looked for
HARDLY = 0.25  # probability of a detection that is looked at; many small people have no more
PARTS = (1.0, 0.7)  # of the shorter side: the windows in which people are looked for
ALIKE = 0.12  # of the smaller crop's side: poses whose landmarks are that near, by the median, are one person's
CLEAR = 0.9  # probability of the pose of somebody who gets an identity; furniture has less
CUT = 0.1  # of a crop's side: whose hips are nearer to the left or right border is cut off there, or imagined beyond it
PAINTED_MOST = 0.3  # share of shoulders and hips on those who are painted over, from which on it is one of them
MOVES = 0.6  # of a crop's side: nobody moves farther to the next frame looked at
GROWS = 0.4  # logarithm of the size: nobody changes by more meanwhile
MOSTLY = 90  # per cent of a machine's pixels that change by less than STILL before a camera that stands
STILL = 15.0  # of 255; of somebody so many pixels change by 25 to 150
WITHIN = 0.4  # of a person's crop, so large at least is another who begins within it; hands and furniture are smaller


def everybody(job: Job, network: BlazePose, images: Images) -> list[Sighting]:
    """Everybody whom a clip (uint8 [H,W,3] in order of time) shows, in the frame that shows the most, from large to small.

    Who counts is seen again half-way to the frames looked at before or after, and is not part of a picture that never
    changes: a note says where somebody may be who does not.
    """
    looked = evenly(len(images), SEEDS)
    seen = {i: sight_in(network, images[i], i) for i in looked}
    best, machines = list[Sighting](), list[Sighting]()
    for k in sorted(range(len(looked)), key=lambda k: _clarity(seen[looked[k]]), reverse=True):
        here = seen[looked[k]]
        if len(here) <= max(len(best), 1):
            break
        beside = {(looked[k] + other) // 2 for other in looked[max(k - 1, 0) : k + 2]} - {looked[k]}
        for i in beside - seen.keys():
            seen[i] = sight_in(network, images[i], i)
        again = [one for i in beside for one in seen[i]]
        sure = [one for one in here if not beside or any(_seen_again(one, other) for other in again)]
        still = [_is_still(network, images, one, looked) for one in sure]
        best = max(best, [one for one, stays in zip(sure, still) if not stays], key=len)
        machines = machines or [one for one, stays in zip(sure, still) if stays]
    if machines:
        said = "; ".join(describe_place(one) for one in machines)
        job.note(f"treated as scene, perhaps a person who never moves: {said}")
    return best


def _clarity(people: list[Sighting]) -> tuple[int, float]:
    """By which frames are ranked: more people first, then those whose least sure person is the surest."""
    return len(people), min((one.score * one.pose.presence for one in people), default=0.0)


def _seen_again(one: Sighting, other: Sighting) -> bool:
    """Whether somebody in one frame may be who is in another close by."""
    a, b = one.pose.next_roi, other.pose.next_roi
    return bool(np.hypot(a.x - b.x, a.y - b.y) < MOVES * a.side and abs(np.log(b.side / a.side)) < GROWS)


def _is_still(network: BlazePose, images: Images, one: Sighting, frames: list[int]) -> bool:
    """Whether what is taken for somebody looks the same in most frames, to the pixel: a machine before a camera that stands."""
    image = images[one.frame]
    _, logits = network.look(image, one.pose.next_roi)
    there = outlined_in(logits, one.pose.next_roi, image.shape) > 0
    changes = [abs(images[i][there].astype(int) - image[there]) for i in frames if i != one.frame and there.any()]
    return bool(changes) and float(np.median([np.percentile(change, MOSTLY) for change in changes])) < STILL


def sight_in(network: BlazePose, image: np.ndarray, i: int) -> list[Sighting]:
    """Everybody in a picture uint8 [H,W,3], frame `i`, from large to small: also in parts of it, and who is hardly a detection.

    Who was found is painted over by their outline: a box around one who raises an arm would hide who stands beside. Who
    stands where an outline of their own holds their trunk is somebody.
    """
    image, here = image.copy(), list[Sighting]()
    (height, width), covered = image.shape[:2], np.zeros(image.shape[:2], np.uint8)
    windows = [None, *(one for part in PARTS for one in squares(height, width, part))]
    while len(here) < MOST:
        known = len(here)
        hits = [hit for window in windows for hit in network.detect(image, window, HARDLY)]
        for score, roi in sorted(hits, key=lambda hit: -hit[0]):
            first, _ = network.look(image, roi)
            pose, logits = network.look(image, first.next_roi)
            theirs = outlined_in(logits, first.next_roi, image.shape)
            there = min(first.presence, pose.presence) >= CLEAR and torso_share(pose, 255 * theirs) > 0.7
            taken = torso_share(pose, covered) > PAINTED_MOST or _cut_off(pose.next_roi, image.shape[1])
            if there and not taken and not any(_same_or_within(one.pose, pose) for one in here):
                here.append(Sighting(i, score, roi, pose))
                paint_over(image, covered, pose.next_roi, theirs)
        if len(here) == known:
            break
    return sorted(here, key=lambda one: -one.pose.next_roi.side)


def outlined_in(logits: np.ndarray, roi: Roi, shape: tuple[int, ...]) -> np.ndarray:
    """Where the outline of a crop's person may be, uint8 [H,W] of 0 and 1."""
    return (paste(sigmoid(logits), roi, shape) > FAINT).astype(np.uint8)


def paint_over(image: np.ndarray, covered: np.ndarray, roi: Roi, theirs: np.ndarray) -> None:
    """Paint one person over, with a rim, and mark it as covered."""
    rim = max(3, round(RIM * roi.side)) | 1
    there = cv2.dilate(theirs, np.ones((rim, rim), np.uint8)) > 0
    image[there], covered[there] = PAINT, 255


def alike(a: Pose, b: Pose) -> bool:
    """Whether two poses in one picture are the same person's; a crop around a large one holds all of a small one."""
    apart = float(np.median(np.linalg.norm(a.xy - b.xy, axis=1)))
    return apart < ALIKE * min(a.next_roi.side, b.next_roi.side)


def _same_or_within(a: Pose, b: Pose) -> bool:
    """Whether the pose `b` is `a` again, or too small for another person so close to them."""
    return alike(a, b) or (a.next_roi.covers(b.next_roi) and b.next_roi.side < WITHIN * a.next_roi.side)


def _cut_off(roi: Roi, width: int) -> bool:
    """Whether the middle of a person's crop is beyond the left or right border of the picture, or close to it."""
    return min(roi.x, width - roi.x) < CUT * roi.side

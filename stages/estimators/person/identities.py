"""Everybody in a clip at once: who is who from frame to frame, also where people cross, and whose a pixel is.

A person is known by where they were going and by the colours they wear. Following each alone does not do: the crop of one
who is hidden slips onto who hides them, and stays there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from stages.contract import Job
from stages.estimators.person.blazepose import SURE, TORSO, WIDER, BlazePose, Images, Pose, Sighting, torso_share
from stages.estimators.person.crops import Roi
from stages.estimators.person.people import describe_place
from stages.estimators.person.sightings import PAINT, PAINTED_MOST, alike, outlined_in, paint_over

STEP = 0.6  # of the crop's side: nobody moves farther from where they were going between two frames
STEP_MORE = 0.1  # by which that grows with each frame in which they were not seen
COLOUR = 0.02  # of the crop's side that a difference of one unit of colour (Lab) counts as
COLOUR_MOST = 0.9  # of the crop's side that colours count as at most: a leg that is thrown up shows what is behind it
SIZE = 1.0  # of the crop's side that a difference of one in the logarithm of the size counts as
AGAIN = 0.1  # of the crop's side that it costs to be seen again: who was seen in the frame before goes on
MISSED = 1.1  # of the crop's side that it costs not to be seen: nobody takes what fits them worse, only to be seen
ASIDE = (0.25, -0.25, 0.5, -0.5)  # of a crop's side: who is not found where they were going is looked for so far beside
SAME = 0.3  # of the crop's side: so near are the hips in two looks at one person, whose landmarks are hardly `alike`
LEARN = 0.1  # share that a frame adds to what is known of somebody's colours
DOUBT = 0.15  # by so much less, at least, must the choice that was made cost than the exchange of the two
LASTING = 0.1  # share of the frames in which somebody is seen who gets an avatar
LOST = 5  # frames after which somebody who is not seen is looked for where they were last, not where they were going


@dataclass
class Identity:
    """What is known of a person while they are followed: where they are, where they go, and their colours."""

    roi: Roi
    colours: np.ndarray
    speed: np.ndarray = field(default_factory=lambda: np.zeros(2))
    unseen: int = 0

    @property
    def expected(self) -> Roi:
        """Where they should be in the next frame."""
        x, y = np.array([self.roi.x, self.roi.y]) + self.speed * (min(self.unseen, LOST) + 1)
        return Roi(float(x), float(y), self.roi.side, self.roi.angle)

    def cost(self, pose: Pose, colours: np.ndarray) -> float:
        """How unlike them a pose is, in sides of their crop; infinite where they cannot be."""
        at, there = self.expected, pose.next_roi
        away = float(np.hypot(at.x - there.x, at.y - there.y)) / at.side
        if away > STEP + STEP_MORE * self.unseen:
            return np.inf
        grown = abs(float(np.log(there.side / at.side)))
        unlike = min(COLOUR * float(np.linalg.norm(self.colours - colours)), COLOUR_MOST)
        return away + AGAIN * bool(self.unseen) + SIZE * grown + unlike

    def meet(self, pose: Pose, colours: np.ndarray, alone: bool) -> None:
        """They are seen there; who is not `alone` shows colours that may be another's."""
        moved = np.array([pose.next_roi.x - self.roi.x, pose.next_roi.y - self.roi.y]) / (self.unseen + 1)
        self.speed, self.roi, self.unseen = 0.5 * (self.speed + moved), pose.next_roi, 0
        if alone:
            self.colours = (1 - LEARN) * self.colours + LEARN * colours

    def miss(self) -> None:
        """They are not seen."""
        self.unseen += 1
        if self.unseen > LOST:
            self.speed = np.zeros(2)


def follow_everybody(
    job: Job, network: BlazePose, images: Images, names: Sequence[str], people: list[Sighting]
) -> list[list[Pose | None]]:
    """The poses of each of `people`, who are in one frame, in all frames; None where they are not seen.

    A warning names frames after which two may have been exchanged, and who is left out: those hardly seen have no poses to fit.
    """
    said = "; ".join(f"{i} {describe_place(one)}" for i, one in enumerate(people, 1))
    job.note(f"{len(people)} people in frame {names[people[0].frame]}: {said}")
    return lasting(job, _follow_each(job, network, images, names, people))


def follow_among(
    job: Job,
    network: BlazePose,
    images: Images,
    names: Sequence[str],
    people: list[Sighting],
    start: Sighting,
    wanted: bool,
) -> list[list[Pose | None]]:
    """The poses of each of `people` in all frames, first of the one who is `start`; nothing if it is none of them.

    Unless they are `wanted`, somebody goes before them who is seen more than twice as often: a note says whom.
    """
    tracks = _follow_each(job, network, images, names, people)
    roi, here = start.pose.next_roi, [track[start.frame] for track in tracks]
    away = [np.inf if one is None else np.hypot(one.next_roi.x - roi.x, one.next_roi.y - roi.y) for one in here]
    chosen = int(np.argmin(away))
    if away[chosen] >= SAME * roi.side:
        return []
    seen = [sum(pose is not None for pose in track) for track in tracks]
    if not wanted and max(seen) > 2 * seen[chosen]:
        most = int(np.argmax(seen))
        job.note(
            f"the largest is seen in {seen[chosen]} of {len(names)} frames; another, seen in {seen[most]}, is followed: in frame "
            f"{names[people[most].frame]} {describe_place(people[most])}"
        )
        chosen = most
    return [tracks[chosen], *tracks[:chosen], *tracks[chosen + 1 :]]


def _follow_each(
    job: Job, network: BlazePose, images: Images, names: Sequence[str], people: list[Sighting]
) -> list[list[Pose | None]]:
    """The poses of each of `people` in all frames; a warning names frames after which two may have been exchanged."""
    fullest = people[0].frame
    poses: list[list[Pose | None]] = [[None] * len(names) for _ in people]
    doubts: set[int] = set()
    for order in (range(fullest, len(names)), range(fullest - 1, -1, -1)):
        known = [Identity(one.pose.next_roi, colours_of(images[fullest], one.pose)) for one in people]
        for i in order:
            found, doubtful = _meet(network, images[i], known)
            doubts |= {i} if doubtful else set()
            for k, pose in enumerate(found):
                poses[k][i] = pose
    if doubts:
        first = names[min(doubts)]
        job.warn(
            f"identities are uncertain in {len(doubts)} of {len(names)} frames, first {first}: look whether two people were "
            "exchanged there; masks with an id for each person (SAM 2) keep them apart"
        )
    return poses


def lasting(job: Job, poses: list[list[Pose | None]]) -> list[list[Pose | None]]:
    """The poses [P][F] of those who are seen in LASTING of the frames; a warning names the others."""
    seen = [sum(pose is not None for pose in theirs) for theirs in poses]
    kept = [theirs for theirs, count in zip(poses, seen, strict=True) if count >= max(2, LASTING * len(theirs))]
    if len(kept) < len(poses):
        few = [f"{k} in {n}" for k, n in enumerate(seen, 1) if n < max(2, LASTING * len(poses[0]))]
        job.warn(
            f"found again in too few of {len(poses[0])} frames and left out: person {', '.join(few)}; masks with an id for each "
            "person (SAM 2) keep them"
        )
    return kept


def track_masked(
    network: BlazePose, images: Images, masks: Sequence[np.ndarray], others: Sequence[np.ndarray]
) -> list[Pose | None]:
    """The poses of the person whom the `masks` uint8 [H,W] of all frames show, with the `others` painted over.

    None where the mask is empty or does not hold the trunk that was found.
    """
    poses: list[Pose | None] = []
    for i, (mask, other) in enumerate(zip(masks, others, strict=True)):
        last, found = (poses[-1] if poses else None), None
        image = np.where((other > 127)[..., None], np.uint8(PAINT), images[i])
        for roi in ([last.next_roi] if last else []) + ([around_mask(mask)] if (mask > 127).any() else []):
            pose = None if found else network.read(image, roi)
            found = pose if pose is not None and torso_share(pose, mask) > 0.5 else found
        poses.append(found)
    return poses


def around_mask(mask: np.ndarray) -> Roi:
    """The crop of the person whom a mask uint8 [H,W] shows."""
    rows, columns = np.nonzero(mask > 127)
    middle = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
    reach = max(np.ptp(rows), np.ptp(columns)) / 2
    return Roi.around(middle, middle - [0, reach])


def _meet(network: BlazePose, image: np.ndarray, known: list[Identity]) -> tuple[list[Pose | None], bool]:
    """The pose of each identity in the next frame, and whether two of them might as well be exchanged."""
    candidates: list[Pose] = []
    expected, bare = [one.expected for one in known], np.zeros(image.shape[:2], np.uint8)
    _add(network, image, bare, expected, candidates)
    if len(candidates) < len(known):
        around = [Roi(roi.x, roi.y, WIDER * roi.side, 0.0) for roi in expected]
        for picture, covered in ((image, bare), _painted_over(network, image, candidates)):
            found_rois = [roi for window in (None, *around) for _, roi in network.detect(picture, window)]
            aside = [Roi(roi.x + part * roi.side, roi.y, roi.side, roi.angle) for roi in expected for part in ASIDE]
            _add(network, picture, covered, [*expected, *found_rois, *aside], candidates)
    colours = [colours_of(image, pose) for pose in candidates]
    costs = np.array([[one.cost(*seen) for seen in zip(candidates, colours, strict=True)] for one in known])
    costs = costs.reshape(len(known), len(candidates))
    found: list[Pose | None] = [None] * len(known)
    unseen = np.where(np.eye(len(known), dtype=bool), MISSED, np.inf)
    rows, columns = linear_sum_assignment(np.hstack([costs, unseen]))
    taken = {int(row): int(column) for row, column in zip(rows, columns) if column < len(candidates)}
    doubtful = _doubtful(costs, taken)
    for k, one in enumerate(known):
        if k not in taken:
            one.miss()
            continue
        pose = found[k] = candidates[taken[k]]
        alone = not any(_near(pose.next_roi, other.expected) for i, other in enumerate(known) if i != k)
        one.meet(pose, colours[taken[k]], alone)
    return found, doubtful


def _add(
    network: BlazePose, image: np.ndarray, covered: np.ndarray, rois: Sequence[Roi], candidates: list[Pose]
) -> None:
    """Add to the candidates who else is seen in crops of a picture, of which `covered` uint8 [H,W] is painted over."""
    for roi in rois:
        first, _ = network.look(image, roi)
        if first.presence < SURE or any(alike(other, first) for other in candidates):
            continue
        pose = network.average_looks(image, first.next_roi)
        if pose is None or any(alike(other, pose) for other in candidates):
            continue
        if torso_share(pose, covered) <= PAINTED_MOST:
            candidates.append(pose)


def _painted_over(network: BlazePose, image: np.ndarray, people: Sequence[Pose]) -> tuple[np.ndarray, np.ndarray]:
    """The picture with everybody painted over, so that who stands behind or beside them is found; and where, uint8 [H,W]."""
    painted, covered = image.copy(), np.zeros(image.shape[:2], np.uint8)
    for pose in people:
        _, logits = network.look(image, pose.next_roi)
        paint_over(painted, covered, pose.next_roi, outlined_in(logits, pose.next_roi, image.shape))
    return painted, covered


def _near(a: Roi, b: Roi) -> bool:
    """Whether two people's crops are so near that one may be taken for the other."""
    return bool(np.hypot(a.x - b.x, a.y - b.y) < 0.5 * max(a.side, b.side))


def _doubtful(costs: np.ndarray, taken: dict[int, int]) -> bool:
    """Whether exchanging two identities, or giving one's place to another who got none, costs hardly more."""
    for k, column in taken.items():
        for other in range(len(costs)):
            if other == k or np.isinf(costs[other, column]):
                continue
            theirs = taken.get(other)
            if theirs is None:
                more = costs[other, column] - costs[k, column]
            elif np.isfinite(costs[k, theirs]):
                more = costs[k, theirs] + costs[other, column] - costs[k, column] - costs[other, theirs]
            else:
                continue
            if more < DOUBT:
                return True
    return False


def colours_of(image: np.ndarray, pose: Pose) -> np.ndarray:
    """Mean colours (Lab) [6] of the trunk and of the thighs of somebody in a picture uint8 [H,W,3]."""
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.float32)
    left_shoulder, left_hip, right_shoulder, right_hip = (pose.xy[i] for i in TORSO)
    knees = pose.xy[[25, 26]]
    trunk = np.array([left_shoulder, right_shoulder, right_hip, left_hip])
    thighs = np.array([left_hip, right_hip, knees[1], knees[0]])
    found = []
    for corners in (trunk, thighs):
        inside = np.zeros(image.shape[:2], np.uint8)
        cv2.fillConvexPoly(inside, cv2.convexHull(corners.round().astype(np.int32)), 1)
        pixels = lab[inside > 0]
        found.append(pixels.mean(0) if len(pixels) else np.zeros(3, np.float32))
    return np.concatenate(found)

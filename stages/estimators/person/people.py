"""Several people in view of the built-in segmenter: how many there are, who is followed, and which masks cover two."""

from __future__ import annotations

import numpy as np

from stages.contract import Job, StageError
from stages.estimators.person.blazepose import Pose, Sighting, pick_clearest, torso_share

ENOUGH = 4  # frames checked, of which one alone that shows somebody else makes no second person
JUMP = 0.5  # of the crop's side between neighbouring frames: a person does not move that far, so it is somebody else


class Bystanders:
    """Who else is in view of a clip, from `sightings` in a few of its frames (`names`)."""

    def __init__(self, job: Job, names: list[str], sightings: list[Sighting], person: int | str | None):
        self.job, self.names, self.sightings = job, names, sightings
        self.seen: dict[str, bool] = {}
        count = {one.frame: sum(other.frame == one.frame for other in sightings) for one in sightings}
        fullest = max(count, key=lambda frame: (count[frame], -frame), default=None)
        people = [one for one in sightings if one.frame == fullest]
        self.start = pick_clearest(sightings) if person is None else pick_person(people, person, names)
        self.several = len(people) > 1
        if fullest is not None and len(people) > 1:
            people_list = "; ".join(f"{i} {describe_place(one)}" for i, one in enumerate(people, 1))
            frames = sum(n > 1 for n in count.values())
            where = f"{len(people)} people in frame {names[fullest]}"
            if frames == 1 and len(count) >= ENOUGH:
                job.note(f"perhaps {where}, but in none of the other {len(count) - 1} frames checked: {people_list}")
                return
            job.note(f"{where}, several in {frames} of {len(count)} frames checked: {people_list}")
            whom = "the largest" if person is None else f"person {person}"
            job.warn(
                f"{len(people)} people are in view: following {whom}; `--person N` picks another from the list, `--person all` "
                "each of them"
            )

    def look(self, i: int, pose: Pose, mask: np.ndarray) -> None:
        """Remember whether the mask of frame `i` also covers somebody else than `pose`."""
        others = [one for one in self.sightings if one.frame == i and not pose.next_roi.covers(one.pose.next_roi)]
        if others:
            self.seen[self.names[i]] = any(torso_share(one.pose, mask) > 0.5 for one in others)

    def warn_of_jumps(self, poses: list[Pose | None]) -> None:
        """Warn of frames at which the followed person may have become somebody else."""
        jumps = []
        for i in range(1, len(poses)):
            before, pose = poses[i - 1], poses[i]
            if before is not None and pose is not None:
                a, b = before.next_roi, pose.next_roi
                jumps += [self.names[i]] if np.hypot(a.x - b.x, a.y - b.y) > JUMP * max(a.side, b.side) else []
        if jumps:
            self.job.warn(
                f"the followed person jumps in {len(jumps)} of {len(poses)} frames, first {jumps[0]}: it may be somebody else"
            )

    def close(self) -> None:
        """Warn of masks that cover two people, counted where others were seen."""
        both = [name for name, held in self.seen.items() if held]
        if both:
            self.job.warn(
                f"the mask also covers somebody else in {len(both)} of {len(self.seen)} frames checked, first {both[0]}: "
                "the built-in segmenter cannot separate people who overlap; give masks with `--masks`"
            )


def pick_person(people: list[Sighting], person: int | str, names: list[str]) -> Sighting:
    """The `person`-th of those in the frame with the most, from the largest on; StageError if there are not as many."""
    if str(person).isdecimal() and 1 <= int(person) <= len(people):
        return people[int(person) - 1]
    listing = "; ".join(f"{i} {describe_place(one)}" for i, one in enumerate(people, 1)) or "nobody"
    facts = [f"{len(people)} seen" + (f" in frame {names[people[0].frame]}: {listing}" if people else "")]
    raise StageError(f"no person {person!r} in view", "choose one from the list with `--person N`", facts)


def describe_place(one: Sighting) -> str:
    """Where a person stands, in words: the middle of the hips and the size, in px."""
    return f"at x {one.pose.next_roi.x:.0f}, y {one.pose.next_roi.y:.0f} px, {one.pose.next_roi.side:.0f} px across"

"""Finds the person in every frame: takes masks given by the user, or segments by itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypedDict

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.estimators.words import listed
from stages.formats.facts import Listing, read_facts, write_facts
from stages.formats.people import EVERYBODY, PEOPLE

if TYPE_CHECKING:
    import numpy as np

    from stages.estimators.person.blazepose import Pose

PERSON_SHARE = 5e-4
"""Share of the picture below which a mask shows nobody."""
BORDER_SHARE = 0.01
"""Share of a picture's side that the person covers when it counts as cut off there."""
PART = 0.2
"""Share of a mask's largest part from which a second one may be somebody else."""
SHARED = 0.01
"""Share of the people's pixels that two claim, from which on it is said."""
MANY = 0.2
"""Share of frames from which a finding is a warning."""


class FrameMask(TypedDict):
    """What masks.json says of one frame."""

    coverage: float
    touches_border: list[str]


class Params(contract.Params):
    """How to read given masks, which person to follow, and whether outlines are corrected."""

    invert: Literal["auto", "always", "never"] = "auto"
    """Swap person and background of given masks. auto: if they mark most of the picture and of its border."""
    person: Annotated[str, Field(coerce_numbers_to_str=True)] | None = None
    """Person to follow if several are visible: an id that the stage lists when it runs; all: each of them. Default: the largest."""
    outlines: Literal["auto", "always", "never"] = "auto"
    """Correct outlines where other frames show the background. auto: not those of given masks."""


def check(params: Params, *, video: Path, mask_files: Path | None = None) -> None:
    """See `contract.StageModule`: masks that can be of this clip; of a data set's they are checked when it is read."""
    if mask_files is not None:
        from stages.estimators.person.given import check_masks
        from stages.formats.whole_clip import whole_clip

        if clip := whole_clip(video):
            check_masks(mask_files, clip)


def run(job: Job, params: Params, *, frames: Path, mask_files: Path | None = None) -> None:
    """Write masks.json, masks/%06d.png (0..255, 255 = person) for every frame, and the landmarks of the one BlazePose followed.

    Of several people these are everybody's, and people/1/masks, people/2/masks ... are each one's own, none of which share a
    pixel. Without `mask_files` the masks of the data set are used, and without those BlazePose segments the person, and other
    frames, which show what is behind them, correct the outlines.
    Raises StageError if given masks do not fit the frames, or if no frame shows a person.
    """
    from stages.formats.datasets.capture import given_by
    from stages.formats.images import write_mask

    listing = read_facts(frames / "frames.json", Listing)
    names = [frame.name for frame in listing.frames]
    mask_files = mask_files or given_by(frames, "masks")
    if mask_files is not None:
        from stages.estimators.person.given import import_masks

        details, masks = import_masks(job, Path(mask_files), listing, params.invert, params.person)
    else:
        from stages.estimators.person.outline import coverage

        details, masks = {}, segment(job, params, frames, names)
        job.note("outlines by BlazePose, a small network; `--masks DIR` takes better ones")
    given, steps = mask_files is not None, len(names)
    if params.outlines == "always" or (params.outlines == "auto" and not given):
        masks, steps = outlined_by_scene(job, frames, names, masks), 2 * steps
    if not given:
        masks = ([coverage(one) for one in own] for own in masks)
    (job.out / "masks").mkdir(exist_ok=True)
    found: dict[str, FrameMask] = {}
    parts, shared, seen = [], [], []
    for i, (name, each) in enumerate(zip(names, masks, strict=True)):
        mask, own = apart(each)
        write_mask(job.out / "masks" / f"{name}.png", mask)
        found[name] = {"coverage": round(float((mask > 127).mean()), 5), "touches_border": cut_sides(mask)}
        if len(own) == 1:
            parts += [name] if has_second_part(mask) else []
        else:
            for k, one in enumerate(own, 1):
                folder = job.out / PEOPLE / str(k) / "masks"
                folder.mkdir(parents=True, exist_ok=True)
                write_mask(folder / f"{name}.png", one)
            seen.append([bool((one > 127).mean() >= PERSON_SHARE) for one in own])
            shared += [name] if sum(int((one > 127).sum()) for one in each) > (1 + SHARED) * (mask > 127).sum() else []
        job.progress(steps - len(names) + i + 1, steps)
    nobody = [name for name, frame in found.items() if frame["coverage"] < PERSON_SHARE]
    report(job, found, nobody, given, parts)
    if given and (frames / "images").is_dir():
        check_motion(job, listing, frames)
    counted = [sum(there) for there in zip(*seen, strict=True)]
    if params.person == EVERYBODY and not seen:
        job.note("--person all: only one person is found")
    if seen:
        report_people(job, names, counted, shared)
    summary = {"source": "imported" if given else "blazepose", **details, "no_person": nobody, "frames": found}
    if seen:
        summary["people"] = {str(k): {"frames": count} for k, count in enumerate(counted, 1)}
    write_facts(job.out / "masks.json", summary)


def check_motion(job: Job, listing: Listing, frames: Path) -> None:
    """Warn where what moves in the frames lies beside their masks."""
    from stages.estimators.person.what_moves import lies_elsewhere
    from stages.formats.frame_names import matching
    from stages.formats.images import read_image, read_mask

    images, masks, names = frames / "images", job.out / "masks", [frame.name for frame in listing.frames]
    of = len(names), lambda i: read_image(images / f"{names[i]}.png"), lambda i: read_mask(masks / f"{names[i]}.png")
    if lies_elsewhere(*of):
        job.warn(f"what moves lies outside the given masks: are they of other frames? {matching(listing)}")


def segment(job: Job, params: Params, frames: Path, names: list[str]) -> Iterator[list[np.ndarray]]:
    """Follow one person, or all, through the frames by BlazePose; yields a mask uint8 [H,W] of each, empty where they are not.

    Of one it writes landmarks.npz.
    """
    from stages.estimators.person.blazepose import BlazePose
    from stages.estimators.person.identities import follow_among, follow_everybody
    from stages.estimators.person.people import Bystanders
    from stages.estimators.person.sightings import everybody
    from stages.formats.landmarks import write_landmarks

    network, paths = BlazePose(), [frames / "images" / f"{name}.png" for name in names]
    pictures, all_of_them = Pictures(paths), params.person == EVERYBODY
    tracks: list[list[Pose | None]] = []
    if all_of_them:
        people = everybody(job, network, pictures)
        tracks = follow_everybody(job, network, pictures, names, people) if len(people) > 1 else []
        if len(tracks) > 1:
            yield from outlined(pictures, tracks)
            return
    sightings = network.sightings(pictures) or network.sightings(pictures, most=len(pictures))
    bystanders = Bystanders(job, names, sightings, None if all_of_them else params.person)
    start = bystanders.start
    if bystanders.several and start is not None and not all_of_them:
        people, wanted = everybody(job, network, pictures), params.person is not None
        if len(people) > 1:
            tracks = follow_among(job, network, pictures, names, people, start, wanted)
    tracks = tracks or [network.track(pictures, start)]
    write_landmarks(job.out / "landmarks.npz", names, tracks[0])
    bystanders.warn_of_jumps(tracks[0])
    for i, (pose, masks) in enumerate(zip(tracks[0], outlined(pictures, tracks), strict=True)):
        mask = own_mask(masks)
        if pose is not None:
            bystanders.look(i, pose, mask)
        yield [mask]
    bystanders.close()


def outlined_by_scene(
    job: Job, frames: Path, names: list[str], masks: Iterator[list[np.ndarray]]
) -> Iterator[list[np.ndarray]]:
    """The `masks` of each frame, as `segment` yields them, their outlines moved to where the static scene ends."""
    from stages.estimators.person.static_scene import corrected, with_outline

    each = []
    for own in masks:
        each.append(own)
        job.progress(len(each), 2 * len(names))
    everybody = [apart(own)[0] for own in each]
    changed, person = 0, 0
    pictures = Pictures([frames / "images" / f"{name}.png" for name in names])
    for own, before, after in zip(each, everybody, corrected(everybody, pictures), strict=True):
        changed += int(((before > 127) != (after > 127)).sum())
        person += int((before > 127).sum())
        yield with_outline(own, after)
    if changed:
        share = changed / max(person, 1)
        job.note(f"outlines corrected by what other frames show behind them: {share:.1%} of the person's pixels")
    else:
        job.note("outlines stay as they are: no other frame shows what is behind them")


def outlined(pictures: Pictures, tracks: Sequence[Sequence[Pose | None]]) -> Iterator[list[np.ndarray]]:
    """Of each picture the masks uint8 [H,W] of all whose poses are in `tracks`, empty where they are not."""
    import numpy as np

    from stages.estimators.person.outline import outlines

    crops = [[None if pose is None else pose.next_roi for pose in there] for there in zip(*tracks, strict=True)]
    for each in outlines(pictures, crops):
        yield [np.rint(255 * one).astype(np.uint8) for one in each]


class Pictures:
    """Pictures uint8 [H,W,3] on disk as a sequence; each is read when it is needed."""

    def __init__(self, paths: Sequence[Path]):
        self.paths = paths

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, i: int) -> np.ndarray:
        from stages.formats.images import read_image

        return read_image(self.paths[i])


def report_people(job: Job, names: list[str], counts: list[int], shared: list[str]) -> None:
    """Note in how many frames each of several people is seen; warn where their masks overlap."""
    said = ", ".join(f"{k} in {count}" for k, count in enumerate(counts, 1))
    job.note(f"{len(counts)} people, each with masks of their own: person {said} of {len(names)} frames")
    if shared:
        say = job.warn if len(shared) > MANY * len(names) else job.note
        say(
            f"masks of two people overlap in {len(shared)} of {len(names)} frames, first {shared[0]}: these pixels train nobody; "
            "masks with an id for each person (SAM 2) have no such pixels"
        )


def apart(masks: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Everybody's mask uint8 [H,W], and each one's own: a pixel that two claim is nobody's."""
    import numpy as np

    if len(masks) == 1:
        return masks[0], list(masks)
    each = np.stack(masks)
    twice = (each > 127).sum(0) > 1
    return each.max(0), list(np.where(twice, 0, each).astype(np.uint8))


def own_mask(masks: Sequence[np.ndarray]) -> np.ndarray:
    """The first of the masks uint8 [H,W] of people, without the pixels that another is surer of."""
    import numpy as np

    return np.where(masks[0] >= np.max(masks, axis=0), masks[0], 0).astype(np.uint8)


def has_second_part(mask: np.ndarray) -> bool:
    """True if the mask has a second part that is large beside its largest."""
    import cv2
    import numpy as np

    _, _, stats, _ = cv2.connectedComponentsWithStats((mask > 127).astype(np.uint8))
    areas = np.sort(stats[1:, cv2.CC_STAT_AREA])
    return len(areas) > 1 and bool(areas[-2] > PART * areas[-1])


def cut_sides(mask: np.ndarray) -> list[str]:
    """The sides of the picture at which the person is cut off."""
    sides = {"top": mask[0], "bottom": mask[-1], "left": mask[:, 0], "right": mask[:, -1]}
    return [side for side, line in sides.items() if (line > 127).mean() > BORDER_SHARE]


def report(job: Job, found: dict[str, FrameMask], nobody: list[str], given: bool, parts: list[str]) -> None:
    """Note how much of the pictures the person covers, and where they are missing or cut off; StageError if nowhere.

    `given`: the masks are the user's; `parts`: frames whose mask has a second large part.
    """
    count = len(found)
    if len(nobody) == count and given:
        raise StageError(
            f"the given masks show nobody in any of {count} frames",
            "look at them: is the person white? `--set masks.invert=always` swaps; `--person ID` picks another object",
        )
    if len(nobody) == count:
        raise StageError(
            f"no person found in any of {count} frames",
            "film one person, whole and upright; or give masks with `--masks DIR`",
            ["the built-in segmenter follows one person and needs some of the body in view"],
        )
    shares = sorted(frame["coverage"] for name, frame in found.items() if name not in nobody)
    job.note(f"person covers {shares[len(shares) // 2]:.1%} of the picture ({shares[0]:.1%} to {shares[-1]:.1%})")
    if nobody:
        say = job.warn if len(nobody) > MANY * count else job.note
        say(f"nobody in {len(nobody)} of {count} frames: {listed(nobody)}")
    for side in ("top", "bottom", "left", "right"):
        cut = [name for name, frame in found.items() if side in frame["touches_border"]]
        if cut:
            say = job.warn if len(cut) > MANY * count else job.note
            say(f"the person is cut off at the {side} in {len(cut)} of {count} frames: {listed(cut)}")
    if len(parts) > MANY * count:
        job.warn(
            f"the masks have a second large part in {len(parts)} of {count} frames, first {parts[0]}: is it "
            "somebody else? Masks with an id for each person (SAM 2, COCO) let one be picked with --person"
        )

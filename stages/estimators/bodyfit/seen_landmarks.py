"""Which landmarks the body is fitted to: those by which the masks were made, BlazePose's of whom the masks show, or a file's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages.contract import StageError
from stages.estimators.bodyfit.evidence import FLAT, LandmarkEvidence, drop_cut, drop_strangers, gather, vote_sides
from stages.estimators.bodyfit.given_landmarks import given_landmarks
from stages.estimators.bodyfit.heading import drop_turned
from stages.estimators.bodyfit.inputs import Inputs
from stages.estimators.bodyfit.landmark_error import weighed
from stages.estimators.person import identities
from stages.estimators.person.blazepose import BlazePose, pick_masked
from stages.formats.datasets.undistorted import read_lenses
from stages.formats.landmarks import read_landmarks
from stages.records import SeenLandmarks

SEEN_LEAST = 0.1  # share of the frames that must show a person


def follow(sfm: Path, clip: Inputs, images: Sequence[np.ndarray]) -> Sequence[SeenLandmarks | None]:
    """The person's landmarks in each frame: those by which the masks were made, else BlazePose's of whom the masks show."""
    if (sfm / "landmarks.npz").exists():
        known = read_landmarks(sfm / "landmarks.npz")
        return [known[name] for name in clip.cameras.names]
    network = BlazePose()
    if clip.others:
        return identities.track_masked(network, images, clip.masks, clip.others)
    masked = [i for i, mask in enumerate(clip.masks) if (mask > 127).any()]
    return network.track(images, pick_masked(network.sightings(images, masked), clip.masks))


def evidence_of(
    sfm: Path,
    clip: Inputs,
    images: Sequence[np.ndarray],
    names: tuple[str, ...],
    given: Path | None,
    say: Callable[[str], None],
) -> tuple[Sequence[SeenLandmarks | None], LandmarkEvidence, dict[str, np.ndarray], dict[str, Any]]:
    """The landmarks of each frame, as evidence under the model's `names`; the frames bool [F] of `strangers`, of `sides_exchanged`
    and `turned` against their neighbours; facts about those in the file `given`, which take the place of BlazePose's.

    StageError if nearly no frame shows the person.
    """
    followed = tracks = follow(sfm, clip, images)
    facts: dict[str, Any] = {}
    if given is not None:
        grid_of = read_lenses(sfm, clip.cameras.width, clip.cameras.height)
        tracks, facts = given_landmarks(given, clip.listing, followed, grid_of, clip.cameras.viewmats, say)
    known = evidence = gather(followed, names)
    if given is not None:
        evidence = gather(tracks, names, 1.0 if facts["3d"] else FLAT)
    evidence, strangers = drop_strangers(evidence, clip.masks)
    evidence, swapped = vote_sides(drop_cut(evidence, (clip.cameras.width, clip.cameras.height)))
    evidence, turned = drop_turned(evidence, clip.times)
    count = int(evidence.seen.sum())
    if count < max(2, SEEN_LEAST * len(tracks)):
        who = "a person"
        hint = "use a clip that shows one whole person, or give a fit of your own with --smpl-fit FIT.npz"
        if clip.others:
            who = f"person {clip.person}"
            hint = "leave them out: follow one with `--person ID`, or give masks of the others alone with --masks"
        more = [f"{int(strangers.sum())} more frames showed somebody else than the masked person"]
        raise StageError(f"{who} was found in only {count} of {len(tracks)} frames", hint, more)
    if given is not None:
        evidence, facts["off"] = weighed(evidence, known, clip.masks)
        tracks = [
            one and SeenLandmarks(*(np.nan_to_num(v) for v in (one.xy, one.visibility, one.world))) for one in tracks
        ]
    return tracks, evidence, {"strangers": strangers, "sides_exchanged": swapped, "turned": turned}, facts

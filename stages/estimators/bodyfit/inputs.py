"""What is known of a clip before a body is fitted to a person in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from stages.contract import StageError
from stages.formats.body_model import read_body_model
from stages.formats.cameras import read_cameras
from stages.formats.facts import Listing, Sfm, read_facts
from stages.formats.images import read_mask
from stages.formats.people import masks_of, people_of
from stages.formats.points import read_points
from stages.formats.whole_clip import whole_clip
from stages.records import BodyModel, Cameras

NEXT = 0.005  # of the picture's longer side: people so near in it touch


@dataclass(frozen=True)
class Inputs:
    """The clip as both ways to a body fit need it: `masks` F of uint8 [H,W], `points` [P,3] in SfM units.

    `listing` has the F frames with a camera, and no others, in the order of `cameras`. `moving`: SfM found a camera that moves.
    `others`: F masks of the other people, none where there are none;
    `person` is the number of this one.
    """

    model: BodyModel
    cameras: Cameras
    listing: Listing
    masks: list[np.ndarray]
    points: np.ndarray
    moving: bool
    others: tuple[np.ndarray, ...] = ()
    person: int = 1

    @cached_property
    def times(self) -> np.ndarray:
        """When the frames were taken [F] s."""
        return np.array(self.listing.times(self.cameras.names))

    @cached_property
    def clear(self) -> list[np.ndarray]:
        """The masks, empty where another person touches this one: an outline there is not theirs alone."""
        if not self.others:
            return self.masks
        return [mask * (not touch(mask, other)) for mask, other in zip(self.masks, self.others, strict=True)]


def read_inputs(listing: Listing, sfm: Path, body_model: Path | None) -> Inputs:
    """The cameras, masks and points in the folder of sfm, with the times that frames.json lists."""
    cameras = read_cameras(sfm / "cameras.npz")
    return Inputs(
        model=read_body_model(body_model),
        cameras=cameras,
        listing=listing.of(cameras.names),
        masks=[read_mask(sfm / "masks" / f"{name}.png") for name in cameras.names],
        points=read_points(sfm / "points.ply")[0].astype(np.float64),
        moving=read_facts(sfm / "sfm.json", Sfm).verdict == "moving",
    )


def check_given(video: Path, smpl_fit: Path | None, body_model: Path | None, landmarks: Path | None) -> None:
    """StageError for a file that is no body model, no fit of pictures like the clip's, or no landmarks of it; a data set brings
    its own fit."""
    if body_model is not None:
        read_body_model(body_model)
    if landmarks is not None:
        from stages.estimators.bodyfit.given_landmarks import check_landmarks
        from stages.formats.given_landmarks.recognize import read_landmark_file

        if smpl_fit is not None:
            raise StageError("a body fit and landmarks are given", "give one of them: `--smpl-fit` needs no landmarks")
        if (clip := whole_clip(video)) is not None:
            check_landmarks(landmarks, clip)
        else:
            read_landmark_file(landmarks, (1, 1))
    if smpl_fit is not None and (clip := whole_clip(video)):
        from stages.formats.given_fits.recognize import read_smpl_fit

        read_smpl_fit(smpl_fit, (clip.width, clip.height))


def of_person(clip: Inputs, sfm: Path, person: int) -> Inputs:
    """The clip of one of several people: with their own masks, and those of the others."""
    each = {k: [read_mask(masks_of(sfm, k) / f"{name}.png") for name in clip.cameras.names] for k in people_of(sfm)}
    own = each.pop(person)
    others = tuple(np.maximum.reduce(there) for there in zip(*each.values(), strict=True))
    return replace(clip, masks=own, others=others, person=person)


def touch(mask: np.ndarray, other: np.ndarray) -> bool:
    """Whether two people's masks uint8 [H,W] come as near as NEXT of the picture's longer side."""
    width = 2 * max(1, round(NEXT * max(mask.shape))) + 1
    near = cv2.dilate((mask > 127).astype(np.uint8), np.ones((width, width), np.uint8))
    return bool(near[other > 127].any())

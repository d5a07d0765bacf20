"""What the body fit is given of a clip, on disk: made once, by what the stages masks and smpl call.

A clip's folder:
  images/%06d.png, masks/%06d.png   pictures, and our own masks of them, as the stage masks makes them
  cameras.npz, points.ply           as the sfm stage has them
  landmarks.npz                     BlazePose's landmarks of the masked person
  facts.json                        fps, moving, half
  truth/                            cameras.npz, body.npz, body_model.npz (m, y up, floor at y = 0) and masks/;
                                    world.npz, the similarity from the world of cameras.npz above
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages import masks as masks_stage
from stages.contract import Job
from stages.estimators.bodyfit.evidence import (
    LandmarkEvidence,
    drop_cut,
    drop_strangers,
    gather,
    model_landmarks,
    vote_sides,
)
from stages.estimators.bodyfit.fit import BodyFit, fit_body
from stages.estimators.bodyfit.heading import drop_turned
from stages.formats.arrays import read_npz
from stages.formats.body_model import read_body_model, write_body_model
from stages.formats.cameras import read_cameras, write_cameras
from stages.formats.images import read_mask, write_image, write_mask
from stages.formats.landmarks import read_landmarks
from stages.formats.points import read_points, write_points
from stages.formats.poses import read_poses, write_poses
from stages.records import BodyModel, BodyPoses, Cameras, SeenLandmarks
from tests.made.family.film import film
from tests.made.family.table import Shot
from tests.made.truth import Similarity


@dataclass(frozen=True)
class Take:
    """One clip's evidence: `cameras` in SfM units, `times` [F] s, `images` and `masks` F of uint8 [H,W,3] and [H,W], `points`
    [P,3], `tracks` F of BlazePose's landmarks; `moving` as `fit_body` takes it."""

    cameras: Cameras
    times: np.ndarray
    images: Sequence[np.ndarray]
    masks: list[np.ndarray]
    points: np.ndarray
    tracks: list[SeenLandmarks | None]
    moving: bool


@dataclass(frozen=True)
class Truth:
    """The true person and cameras, m, y up, the floor at y = 0; `masks` F of uint8 [H,W], or none.

    `to_truth` leads from SfM's world and unit to the true ones; None where only the cameras can tell.
    """

    model: BodyModel
    poses: BodyPoses
    cameras: Cameras
    masks: Sequence[np.ndarray] = ()
    to_truth: Similarity | None = None


def make_take(folder: Path, shot: Shot, captures: Path | None) -> None:
    """Film the shot, then find masks and landmarks in its pictures; the folder is complete when it has facts.json."""
    made, names = film(shot, captures), None
    names = made.cameras.names
    for part in ("images", "masks", "truth/masks"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for name, image, mask in zip(names, made.images, made.masks, strict=True):
        write_image(folder / "images" / f"{name}.png", image)
        write_mask(folder / "truth" / "masks" / f"{name}.png", mask)
    write_cameras(folder / "truth" / "cameras.npz", made.cameras)
    write_poses(folder / "truth" / "body.npz", made.poses)
    write_body_model(folder / "truth" / "body_model.npz", made.model)
    np.savez(folder / "truth" / "world.npz", **vars(made.to_truth))
    write_cameras(folder / "cameras.npz", made.placed)
    write_points(folder / "points.ply", made.points, made.colors)
    find_person(folder, list(names))
    (folder / "facts.json").write_text(json.dumps({"fps": shot.fps, "moving": made.moving, "half": shot.half}) + "\n")


def find_person(folder: Path, names: list[str]) -> None:
    """Write masks/ and landmarks.npz from images/, as the stage masks finds them."""
    job = Job(out=folder, emit=lambda event: None)
    found = masks_stage.segment(job, masks_stage.Params(), folder, names)
    (folder / "masks").mkdir(exist_ok=True)
    for name, (mask,) in zip(names, masks_stage.outlined_by_scene(job, folder, names, found), strict=True):
        write_mask(folder / "masks" / f"{name}.png", mask)


def read_tracks(folder: Path) -> list[SeenLandmarks | None]:
    """The landmarks that `find_person` found."""
    return list(read_landmarks(folder / "landmarks.npz").values())


def read_take(folder: Path) -> tuple[Take, Truth]:
    """What `make_take` wrote."""
    facts, cameras = json.loads((folder / "facts.json").read_text()), read_cameras(folder / "cameras.npz")
    masks, true_masks = (
        [read_mask(at / "masks" / f"{name}.png") for name in cameras.names] for at in (folder, folder / "truth")
    )
    times = np.arange(len(cameras)) / facts["fps"]
    points = read_points(folder / "points.ply")[0].astype(np.float64)
    images = masks_stage.Pictures([folder / "images" / f"{name}.png" for name in cameras.names])
    take = Take(cameras, times, images, masks, points, read_tracks(folder), facts["moving"])
    truth = folder / "truth"
    poses, model = read_poses(truth / "body.npz"), read_body_model(truth / "body_model.npz")
    world = read_npz(truth / "world.npz")
    to_truth = Similarity(float(world["scale"]), world["R"], world["t"])
    return take, Truth(model, poses, read_cameras(truth / "cameras.npz"), true_masks, to_truth)


def fit_take(take: Take, model: BodyModel | None = None) -> tuple[BodyFit, LandmarkEvidence]:
    """The body fit of a clip as the smpl stage makes it, with the free body unless a `model` is given, and its evidence."""
    model = model or read_body_model()
    names, regressor = model_landmarks(model)
    evidence, _ = drop_strangers(gather(take.tracks, names), take.masks)
    evidence, _ = vote_sides(drop_cut(evidence, (take.cameras.width, take.cameras.height)))
    evidence, _ = drop_turned(evidence, take.times)
    fit = fit_body(
        model, regressor, evidence, take.cameras, take.times, take.masks, take.points, take.moving, take.images
    )
    return fit, evidence

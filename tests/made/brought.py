"""What the commands of the documents are given beside a film, or in place of one: files of other programs, data sets, clips."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from stages.avatar.cameras.pinhole import project
from stages.formats.body_model import write_body_model
from stages.formats.images import write_mask
from stages.formats.landmarks import NAMES
from stages.formats.video import write_video
from stages.records import JOINT_NAMES, Cameras
from tests.made import camera_files, datasets, fits, landmark_files, mask_files
from tests.made.pair import make_pair

FRAMES, WIDTH, HEIGHT, FPS = 12, 192, 256, 12.0
POINTS = 600


@cache
def true() -> fits.Truth:
    """The truth of the film, each of whose pictures is taken."""
    return replace(fits.make_truth(FRAMES, WIDTH, HEIGHT), numbers=np.arange(FRAMES), fps=FPS)


def found(folder: Path) -> None:
    """What other programs find in the film: masks, a fit, cameras, landmarks; and an SMPL model."""
    truth = true()
    (folder / "masks").mkdir()
    for name, mask in zip(truth.names, truth.views.masks, strict=True):
        write_mask(folder / "masks" / f"{name}.png", mask)
    fits.write("WHAM", fits.contents("WHAM", truth), folder)
    landmark_files.openpose(folder / "keypoints", landmarks(truth))
    write_sparse(folder / "sparse" / "0", truth)
    write_smpl(folder / "SMPL_NEUTRAL.pkl", truth)


def data_sets(folder: Path) -> None:
    """A sequence of each, whose poses are SMPL's."""
    datasets.zju(folder / "zju")
    (path,) = (datasets.neuman(folder / "neuman").folder / "4d_humans").glob("smpl_*.npz")
    with np.load(path) as file:
        arrays = {key: file[key] for key in file if key != "body"}
    np.savez(path, **arrays)


def clips(folder: Path) -> None:
    """A folder for the film, where one of noise is already, and a list that names the film there."""
    noise = np.random.default_rng(0).integers(0, 255, (4, 64, 48, 3), np.uint8)
    (folder / "clips").mkdir()
    write_video(folder / "clips" / "noise.mp4", noise, FPS)
    (folder / "clips.csv").write_text("clip\nclips/dance.mp4\n")


def two_people(folder: Path) -> None:
    """Another dance.mp4, in a folder of its own, and masks that tell them apart."""
    pair = make_pair(seed=7, width=320, height=180, frames=FRAMES, fps=8.0)
    folder.mkdir()
    write_video(folder / "dance.mp4", pair.views[0].images, 8.0, crf=14)
    (folder / "ids").mkdir()
    for i, (one, other) in enumerate(zip(*(view.masks for view in pair.views), strict=True)):
        write_mask(folder / "ids" / f"{i:06d}.png", mask_files.ids(one > 127, other > 127))


def write_sparse(folder: Path, truth: fits.Truth) -> None:
    """The true cameras as COLMAP writes them, in metres, with points of the room."""
    views, metre = truth.views, 1 / camera_files.UNITS  # of which a unit of the files has so many
    at = np.array(datasets.points_of(views, POINTS))
    z = views.depths[at[:, 0], at[:, 2], at[:, 1]]
    rays = np.stack([at[:, 1] + 0.5, at[:, 2] + 0.5, np.ones(len(at))], 1) @ np.linalg.inv(views.Ks[0]).T
    seen, viewmats = views.viewmats[at[:, 0]], views.viewmats.copy()
    world = np.einsum("nji,nj->ni", seen[:, :3, :3], rays * z[:, None] - seen[:, :3, 3])
    viewmats[:, :3, 3] *= metre
    cameras = Cameras(truth.names, viewmats, views.Ks, WIDTH, HEIGHT)
    camera_files.colmap(folder, cameras, metre * world, views.images[at[:, 0], at[:, 2], at[:, 1]])


def landmarks(truth: fits.Truth) -> np.ndarray:
    """Where the limbs' joints are, px [F,33,2] by BlazePose's names; NaN for other landmarks."""
    places, _ = project(truth.views.joints, truth.views.viewmats, truth.views.Ks)
    points = np.full((FRAMES, len(NAMES), 2), np.nan)
    for k, name in enumerate(JOINT_NAMES):
        if name in NAMES:
            points[:, NAMES.index(name)] = places[:, k]
    return points


def write_smpl(path: Path, truth: fits.Truth) -> None:
    """The body of the truth as SMPL's own pickle."""
    write_body_model(path.with_suffix(".npz"), truth.model)
    with np.load(path.with_suffix(".npz")) as file:
        arrays = {key: file[key] for key in file if key != "name" and not key.startswith("keypoint")}
    path.with_suffix(".npz").unlink()
    path.write_bytes(pickle.dumps(arrays, protocol=2))

"""Joins cameras of another program to a clip's frames, and replaces their lenses by pinholes."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from stages.avatar.cameras import lens as lenses
from stages.avatar.cameras.pinhole import camera_centers, pinhole
from stages.contract import Job, StageError
from stages.estimators.cameras import colmap
from stages.estimators.cameras.sparse_model import Pinholes
from stages.formats.datasets.undistorted import HELD, Grid
from stages.formats.facts import Listing
from stages.formats.frame_names import count_from_one, has_sources, join, number, stem
from stages.formats.given_cameras.recognize import check_shape, read_camera_files
from stages.formats.given_cameras.record import GivenCameras, Lens, widest_angles

STILL = 1e-9  # of the cameras' distance from the origin, or 1: a camera that moves less stands


def import_cameras(job: Job, path: Path, listing: Listing, min_share: float, first: Literal["auto", 0, 1]) -> Pinholes:
    """The cameras in `path` of the frames in `listing` (frames.json); StageError if they cannot belong to these frames.

    At least `min_share` of the frames need a camera. `first` is the number of the video's first frame in the names.
    """
    size = width, height = listing.width, listing.height
    given = read_camera_files(path, *size)
    rows = match_frames(job, given, listing, min_share, first)
    check_shape(given, *size)
    own = given.lenses[0]
    if (off := shape_off((own.width, own.height), size)) > 0:
        job.warn(
            f"the given cameras are for {own.width}x{own.height}; the frames, {width}x{height}, differ in shape by {off:.0f} px: if"
            f" the cameras belong to undistorted or cropped pictures, give these: `hugs run PICTURES/ --cameras {path}`"
        )
    order = list(rows.values())
    made = {lens: straighten(lens, *size) for lens in {given.lenses[i] for i in order}}
    Ks, _, shifts = zip(*(made[given.lenses[i]] for i in order), strict=True)
    missing, verdict = len(listing.frames) - len(order), motion_of(given.viewmats[order])
    job.note(f"{len(order)} cameras from a {given.source}; their lens moves pixels by up to {max(shifts):.1f} px")
    if missing:
        job.warn(f"{missing} of {len(listing.frames)} frames have no camera in {path.name} and are left out")
    if verdict != "moving":
        do = "stand still" if verdict == "static camera" else "only turn"
        job.warn(f"the given cameras {do}: the clip shows no depth, so only the person is modelled")
    lens, focal = given.lenses[order[0]], float(np.median([K[0, 0] for K in Ks]))
    facts = {
        "source": given.source,
        "focal_px": lens.K[0, 0] * width / lens.width,
        "focal_source": "given",
        "pinhole_focal_px": focal,
        "distortion": {"model": lens.model, "params": lens.distortion.tolist(), "max_shift_px": max(shifts)},
    }
    cloud = cloud_of(given, order, width / own.width) if len(given.points) else None

    @lru_cache(HELD)
    def grid(lens: Lens) -> Grid:
        return sample_grid(lens, made[lens][0], *size)

    def grid_of(name: str) -> Grid | None:
        lens = given.lenses[rows[name]]
        return grid(lens) if made[lens][1] else None

    return Pinholes(verdict, list(rows), given.viewmats[order], np.stack(Ks), grid_of, facts, None, cloud)


def shape_off(theirs: tuple[int, int], ours: tuple[int, int]) -> float:
    """By how many of our px a picture of another size (width, height) has another shape than ours; 0 within rounding."""
    off = max(abs(theirs[0] * ours[1] / theirs[1] - ours[0]), abs(theirs[1] * ours[0] / theirs[0] - ours[1]))
    return off if off > 1 + max(ours[0] / theirs[0], ours[1] / theirs[1]) else 0.0


def match_frames(
    job: Job, given: GivenCameras, listing: Listing, min_share: float, first: Literal["auto", 0, 1]
) -> dict[str, int]:
    """Frame name -> row of its camera; StageError if too few have one, or numbers could count from 0 or from 1."""
    stems = [stem(file) for file in given.files]
    names, total = [frame.name for frame in listing.frames], listing.video.frames
    numbers = {number(name) for name in stems}
    picked = len(names) < total and set(stems) <= set(names)  # the frames of an earlier run
    sure = has_sources(listing) or 0 in numbers or picked or numbers == {None} or count_from_one(total, numbers)
    if first == "auto" and not sure:
        facts = [f"the names run from {given.files[0]} to {given.files[-1]}, the video has {total} frames"]
        hint = (
            "say which number the first frame has with `--set sfm.cameras_from=0` or `=1`; where the pictures are "
            "every few frames of the video, give their folder in place of the video"
        )
        raise StageError("the names of the given cameras do not match those of the frames", hint, facts)
    rows = join(listing, stems, "cameras", job.warn, None if first == "auto" else first)
    missing = [name for name in names if name not in rows]
    if len(rows) < math.ceil(min_share * len(names)):
        facts = [
            f"missing: {', '.join(missing[:5])} and so on" if len(missing) > 5 else f"missing: {', '.join(missing)}",
            f"given: {len(given)} cameras, {given.files[0]} to {given.files[-1]}; frames {names[0]} to {names[-1]}",
        ]
        hint = "names are those of the pictures, or have the frame's number in the video; `hugs run PICTURES/` joins by name"
        raise StageError(f"{len(missing)} of {len(names)} frames have no camera", hint, facts)
    return rows


def cloud_of(given: GivenCameras, order: list[int], scale: float) -> colmap.Cloud:
    """The given points, with tracks as rows of the frames and errors in their pixels."""
    row = {i: k for k, i in enumerate(order)}
    return colmap.Cloud(
        ids=np.arange(1, len(given.points) + 1),
        xyz=given.points,
        rgb=given.colors,
        errors=given.errors * scale,
        lengths=np.array([len(track) for track in given.tracks]),
        angles=widest_angles(given.points, given.tracks, camera_centers(given.viewmats)),
        tracks=tuple(np.array([row[i] for i in track.tolist() if i in row], np.int64) for track in given.tracks),
    )


def straighten(lens: Lens, width: int, height: int) -> tuple[np.ndarray, bool, float]:
    """K [3,3] of the pinhole that replaces a lens, whether its picture must be sampled anew, and its largest move in px.

    K is for pictures of `width` x `height`. A lens that bends is replaced by the centred pinhole with the
    smallest focal length that sees nothing outside its picture. StageError for a lens that folds over or sees sideways.
    """
    scale = np.array([width / lens.width, height / lens.height])
    K = np.diag([*scale, 1.0]) @ lens.K
    if lens.model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return K, False, 0.0
    camera = colmap.camera_of(lens)
    outline = lenses.border(lens.width, lens.height)
    ideal = camera.cam_from_img(outline)
    whole = np.isfinite(ideal).all()
    back = camera.img_from_cam(np.c_[ideal, np.ones(len(ideal))]) if whole else np.full_like(outline, np.nan)
    if not np.abs(back - outline).max() < 0.01:
        fact = f"{lens.model} {' '.join(f'{value:g}' for value in lens.params)} for {lens.width}x{lens.height}"
        hint = "undistort the pictures in the program that found the cameras, and give both"
        raise StageError("a given lens cannot be turned into a pinhole", hint, [fact])
    shift = float(np.linalg.norm((ideal @ lens.K[:2, :2].T + lens.K[:2, 2] - outline) * scale, axis=1).max())
    if shift < lenses.NO_SHIFT:
        return K, False, shift
    try:
        focal = lenses.focal_within(ideal, width, height)
    except ValueError as error:
        raise StageError(
            str(error), "undistort the pictures in the program that found the cameras, and give both"
        ) from error
    return pinhole(focal, width, height), True, shift


def sample_grid(lens: Lens, K: np.ndarray, width: int, height: int) -> Grid:
    """Where the picture of a lens is sampled for that of a pinhole `K` [3,3] of `width` x `height`; as `remap_grid`."""
    scale = np.array([width / lens.width, height / lens.height])
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1).reshape(-1, 3)
    source = (colmap.camera_of(lens).img_from_cam(rays) * scale - 0.5).astype(np.float32).reshape(height, width, 2)
    return source[..., 0], source[..., 1]


def motion_of(viewmats: np.ndarray) -> Literal["moving", "rotation only", "static camera"]:
    """How the cameras [C,4,4] move."""
    centers = camera_centers(viewmats)
    if np.ptp(centers, axis=0).max() > STILL * max(1.0, np.abs(centers).max()):
        return "moving"
    return "rotation only" if np.ptp(viewmats[:, :3, :3], axis=0).max() > STILL else "static camera"

"""frames, masks (or cameras of another program) -> cameras.npz, points.ply, undistorted images/, masks/, sparse/, sfm.json."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.formats.facts import Listing, read_facts, write_facts

if TYPE_CHECKING:
    from stages.estimators.cameras.intrinsics import Prior
    from stages.estimators.cameras.parts import Parts
    from stages.estimators.cameras.sparse_model import Pinholes

LOADS = ("pycolmap", "scipy.optimize", "cv2")


class Params(contract.Params):
    camera: Literal["auto", "fixed", "moving"] = "auto"
    """auto: measure how the camera moves. fixed: it stands still; nothing is reconstructed, every frame is kept.

    moving: it does not stand still, though captions or a logo do.
    """
    focal: float | None = Field(None, gt=0)
    """Focal length, if known, in px of the frames that the frames stage wrote. Default: estimated."""
    features: int = Field(1536, ge=256)
    """Approximate number of SIFT features in each frame. Matching time grows with the square; 2048 place `courtyard` no better."""
    overlap: int = Field(2, ge=1)
    """Each frame is matched with this many that follow, besides those 1, 2, 4, 8 ... frames later; 1 and 2 add none.

    Time grows with it.
    """
    undistort: Literal["auto", "always", "never"] = "auto"
    """Whether to remove the lens distortion that SfM found. auto: where it moves pixels visibly.

    The distortion of cameras given by `--cameras` is always removed.
    """
    min_share: float = Field(0.5, gt=0, le=1)
    """Share of the frames that must get a pose."""
    cameras_from: Literal["auto", 0, 1] = "auto"
    """Number of the video's first frame in the names of `--cameras`. auto: found from the names if possible."""


def check(params: Params, *, video: Path, cameras: Path | None = None, smpl_fit: Path | None = None) -> None:
    """See `contract.StageModule`: cameras, and a fit, of pictures like this clip's; a data set brings its own."""
    if cameras is None and smpl_fit is None:
        return
    from stages.formats.whole_clip import whole_clip

    if clip := whole_clip(video):
        if cameras is not None:
            from stages.formats.given_cameras.recognize import check_shape, read_camera_files

            check_shape(read_camera_files(cameras, clip.width, clip.height), clip.width, clip.height)
        if smpl_fit is not None:
            from stages.formats.given_fits.recognize import fit_focal

            fit_focal(smpl_fit, (clip.width, clip.height))


def run(
    job: Job,
    params: Params,
    *,
    frames: Path,
    masks: Path,
    cameras: Path | None = None,
    smpl_fit: Path | None = None,
) -> None:
    """Solve the camera of each frame, with the person masked out, and undistort the frames.

    `cameras` of another program (a COLMAP model, transforms.json) take the place of mapping; where they have no points,
    COLMAP triangulates them. Of `smpl_fit` only the focal length counts, if its tool has one and the video tells none: with
    it a camera that stands still sees the person as the tool did. A camera that stood still or only turned is named in
    sfm.json `verdict` and by a warning.
    """
    from stages.estimators.cameras.check import compare_colors, compare_stillness, triangulate
    from stages.estimators.cameras.given import import_cameras
    from stages.estimators.cameras.parts import Parts
    from stages.estimators.cameras.sparse_model import write_model
    from stages.formats.cameras import write_cameras
    from stages.formats.datasets.undistorted import write_undistorted
    from stages.records import Cameras

    listing = read_facts(frames / "frames.json", Listing)
    names, size = [frame.name for frame in listing.frames], (listing.width, listing.height)
    parts = Parts()
    with parts.timed("masks"):
        check_masks(names, masks, *size)
    with tempfile.TemporaryDirectory(dir=job.out) as scratch:
        if cameras is None:
            told = None if params.focal else what_is_told(job, listing, smpl_fit)
            found = map_cameras(job, params, listing, frames, masks, Path(scratch), parts, told)
        else:
            found = import_cameras(job, Path(cameras), listing, params.min_share, params.cameras_from)
        with parts.timed("pictures"):
            for done in write_undistorted(frames, masks, job.out, found.names, found.grid_of):
                job.progress(85 + 14 * done // len(found.names), 100)
        write_cameras(job.out / "cameras.npz", Cameras(tuple(found.names), found.viewmats, found.Ks, *size))
        if found.cloud is not None:
            compare_colors(job, found, found.cloud, size)
        elif cameras is not None and found.verdict == "moving":
            triangulate(job, found, size, params.features, Path(scratch))
        elif cameras is not None:
            compare_stillness(job, found, size, Path(scratch))
    with parts.timed("points"):
        model = write_model(job, found, size)
    facts = {
        "verdict": found.verdict,
        "registered": len(found.names),
        "of": len(names),
        "dropped": [name for name in names if name not in set(found.names)],
        **found.facts,
        **model,
    }
    write_facts(job.out / "sfm.json", facts)
    # Not in sfm.json: the same clip gives the same bytes, and the stages after it stay fresh.
    job.note(f"time by part: {parts}")


def what_is_told(job: Job, listing: Listing, smpl_fit: Path | None) -> Prior | None:
    """The focal length that the video's file tells, or else the tool that made `smpl_fit`; None if neither does."""
    from stages.estimators.cameras.intrinsics import FOCAL_SPREAD, Prior
    from stages.formats.frame_names import plain
    from stages.formats.given_fits.recognize import fit_focal

    size = (listing.width, listing.height)
    if listing.focal is not None:
        told = Prior(listing.focal.share * max(size), listing.focal.spread, listing.focal.words)
    elif smpl_fit is not None and (found := fit_focal(smpl_fit, size)):
        told = Prior(found[0], FOCAL_SPREAD, f"{found[1]}'s, {plain(smpl_fit.name)}")
    else:
        return None
    job.note(f"focal length before SfM: {told.said}")
    return told


def map_cameras(
    job: Job,
    params: Params,
    listing: Listing,
    frames: Path,
    masks: Path,
    scratch: Path,
    parts: Parts,
    told: Prior | None,
) -> Pinholes:
    """Cameras found by COLMAP, and the pinhole that replaces their lens; `told` is what a file says of it."""
    from stages.estimators.cameras import solving, standing
    from stages.estimators.cameras.pinholes import pinholes_of
    from stages.estimators.cameras.task import Task

    task = Task(
        job=job,
        names=[frame.name for frame in listing.frames],
        size=(listing.width, listing.height),
        images=frames / "images",
        masks=masks,
        scratch=scratch,
        parts=parts,
        features=params.features,
        overlap=params.overlap,
        min_share=params.min_share,
        focal=params.focal,
        told=told,
        moves=params.camera == "moving",
    )
    if params.camera == "fixed":
        solution = standing.still(task, {})
        job.note("the camera is assumed to stand still, as set")
    else:
        solution = solving.solve(task)
    return pinholes_of(task, solution, params.undistort)


def check_masks(names: list[str], masks: Path, width: int, height: int) -> None:
    """Raise StageError unless each frame has a mask of the frame's size; COLMAP would ignore it without a word."""
    from stages.formats.images import read_mask

    hint = "run the masks stage again: `hugs run VIDEO masks --force`"
    missing = [name for name in names if not (masks / "masks" / f"{name}.png").is_file()]
    if missing:
        raise StageError(f"{len(missing)} of {len(names)} frames have no mask", hint, [f"the first is {missing[0]}"])
    for name in names:
        shape = read_mask(masks / "masks" / f"{name}.png").shape
        if shape != (height, width):
            fact = f"mask {shape[1]}x{shape[0]}, frame {width}x{height}"
            raise StageError(f"the mask of frame {name} has another size", hint, [fact])

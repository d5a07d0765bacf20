"""Takes the cameras of a data set in place of sfm; writes the same files except sparse/."""

from __future__ import annotations

from pathlib import Path

from stages import contract
from stages.contract import Job, StageError
from stages.formats.facts import DatasetListing, GivenSfm, read_facts, write_facts


class Params(contract.Params):
    pass


def run(job: Job, params: Params, *, frames: Path, masks: Path) -> None:
    """Write cameras.npz, points.ply, images/ and masks/ without distortion, split.json and sfm.json."""
    import shutil

    import numpy as np

    from stages.avatar.cameras.lens import NO_SHIFT
    from stages.formats.cameras import read_cameras, write_cameras
    from stages.formats.datasets.capture import GIVEN, given_by, read_lenses
    from stages.formats.datasets.undistorted import opencv_grid, write_undistorted
    from stages.formats.points import read_points
    from stages.formats.splits import write_split

    given = frames / GIVEN
    if given_by(frames, "cameras.npz") is None:
        raise StageError("no cameras came with these frames", "use `stages.sfm` for the frames of a video")
    cameras, listing = read_cameras(given / "cameras.npz"), read_facts(frames / "frames.json", DatasetListing)
    rows = {row.name: (row.split, row.moment) for row in listing.frames}
    if strangers := [name for name in cameras.names if name not in rows]:
        hint = "run the frames stage again: `hugs run FOLDER frames --force`"
        raise StageError(f"{len(strangers)} cameras belong to no frame", hint, [f"the first is {strangers[0]}"])
    lenses = read_lenses(given / "lenses.npz", len(cameras))
    width, height = cameras.width, cameras.height
    grids, shift = {}, 0.0
    keys = [(*K.ravel(), *lens) for K, lens in zip(cameras.Ks, lenses, strict=True)]
    for key, K, lens in zip(keys, cameras.Ks, lenses, strict=True):
        if key not in grids:
            x, y = opencv_grid(K, lens, width, height)
            moved = float(np.hypot(x - np.arange(width), y - np.arange(height)[:, None]).max())
            grids[key], shift = (x, y) if moved >= NO_SHIFT else None, max(shift, moved)
    grid_of = {name: grids[key] for name, key in zip(cameras.names, keys, strict=True)}
    for done in write_undistorted(frames, masks, job.out, list(cameras.names), grid_of.get):
        job.progress(done, len(cameras))
    write_cameras(job.out / "cameras.npz", cameras)
    shutil.copyfile(given / "points.ply", job.out / "points.ply")
    write_split(job.out / "split.json", listing.dataset.rule, rows)
    points = len(read_points(job.out / "points.ply")[0])
    training = np.array([rows[name][0] == "train" for name in cameras.names])
    moving = np.ptp(cameras.centers[training], axis=0).max() > 0
    facts = {
        "verdict": "moving" if moving else "static camera",
        "registered": len(cameras),
        "of": len(listing.frames),
        "dropped": [],
        "focal_px": float(np.median(cameras.Ks[:, 0, 0])),
        "focal_source": "given",
        "distortion": {"model": "OPENCV", "params": lenses[0].tolist(), "max_shift_px": shift},
        "points": points,
        **read_facts(given / "sfm.json", GivenSfm).model_dump(exclude_unset=True),
    }
    write_facts(job.out / "sfm.json", facts)
    job.note(f"{len(cameras)} cameras and {points} points as given; the lens moves pixels by up to {shift:.1f} px")

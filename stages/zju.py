"""Reads a sequence of ZJU-MoCap in place of a video: one camera to learn from, the others to measure on."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from stages import contract
from stages.contract import Job


class Params(contract.Params):
    train_camera: int = Field(0, ge=0)
    """Row in annots.npy of the camera to learn from; 0 is the one that papers call camera 1."""
    train_frames: int = Field(570, gt=0)
    """Moments to learn from, from the first on. More need more memory."""
    test_every: int = Field(30, gt=0)
    """The other cameras are measured at every so many of these moments."""
    max_side: int = Field(512, ge=64)
    """Longer side of the pictures in px; the data set's own are 1024, which need four times the memory."""


def check(params: Params, *, video: Path) -> None:
    """See `contract.StageModule`."""
    from stages.formats.datasets.zju import check_folder

    check_folder(video)


def run(job: Job, params: Params, *, video: Path) -> None:
    """Write images/, frames.json and given/ (masks, cameras, body poses) from a ZJU-MoCap sequence's folder."""
    from stages.formats.datasets.capture import write_capture
    from stages.formats.datasets.zju import read_zju

    capture = read_zju(video, params.train_camera, params.train_frames, params.test_every)
    for done in write_capture(job.out, capture, params.max_side):
        job.progress(done, len(capture.shots))
    heldout = sum(shot.split == "heldout" for shot in capture.shots)
    job.note(f"{len(capture.shots) - heldout} train, {heldout} heldout. {capture.rule}")
    if not heldout:
        job.warn("annots.npy has one camera only: nothing is held out")

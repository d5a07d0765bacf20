"""Reads a sequence of the NeuMan data set in place of a video: pictures, masks, cameras, body poses and HUGS's split."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from stages import contract
from stages.contract import Job


class Params(contract.Params):
    max_side: int = Field(1280, ge=64)
    """Longer side of the pictures in px; larger ones are shrunk. The data set's own are 1276."""


def check(params: Params, *, video: Path) -> None:
    """See `contract.StageModule`."""
    from stages.formats.datasets.neuman import check_folder

    check_folder(video)


def run(job: Job, params: Params, *, video: Path) -> None:
    """Write images/, frames.json and given/ (masks, cameras, points, body poses) from a NeuMan sequence's folder.

    Its body poses have a scale each; the smpl stage keeps their median for the clip and moves each body along the rays
    of its camera to where that scale shows it unchanged, so its pelvis stays on the same pixel.
    """
    from stages.formats.datasets.capture import write_capture
    from stages.formats.datasets.neuman import read_neuman

    capture = read_neuman(video)
    if capture.lenses.any():
        strongest = abs(capture.lenses).max()
        job.warn(
            f"sparse/cameras.txt has a distortion of up to {strongest:.3g}, ignored: the pictures are already without it"
        )
        capture.lenses[:] = 0
    for done in write_capture(job.out, capture, params.max_side):
        job.progress(done, len(capture.shots))
    counts = {kind: sum(shot.split == kind for shot in capture.shots) for kind in ("train", "heldout", "unused")}
    job.note(", ".join(f"{count} {kind}" for kind, count in counts.items()) + f". {capture.rule}")

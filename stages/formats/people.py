"""Where a stage keeps what it has of each person of a clip: of the first in its own folder, of others in people/2, people/3.

Masks are of everybody in masks/. Where there are several people, each has their own in people/1/masks, people/2/masks.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.contract import Job

PEOPLE = "people"
EVERYBODY = "all"
"""As a choice of the person: each of those in view."""


def people_of(stage: Path) -> range:
    """The numbers of the people whose masks a stage keeps, from 1 on: 1 alone where there is only one."""
    return range(1, 1 + max(1, len(list((stage / PEOPLE).glob("*/masks")))))


def folder_of(stage: Path, person: int) -> Path:
    """The folder of what a stage has of a person."""
    return stage if person == 1 else stage / PEOPLE / str(person)


def masks_of(stage: Path, person: int) -> Path:
    """The folder of a person's own masks; those of everybody where there is only one."""
    own = stage / PEOPLE / str(person) / "masks"
    return own if own.is_dir() else stage / "masks"


def model_of(smpl: Path, person: int) -> Path:
    """The body model of a person, in the folder of the stage smpl: that of the first where they have no other."""
    own = folder_of(smpl, person) / "body_model.npz"
    return own if own.is_file() else smpl / "body_model.npz"


def job_of(job: Job, person: int) -> Job:
    """The job of one of several people: what it says begins with whom it is about."""

    def emit(event: dict[str, Any]) -> None:
        job.emit(event | {"text": f"person {person}: {event['text']}"} if "text" in event else event)

    return replace(job, emit=emit)

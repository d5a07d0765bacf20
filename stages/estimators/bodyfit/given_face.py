"""A face capture of the clip, brought by the user: coefficients of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages.avatar.motion.between import between
from stages.contract import Job, StageError
from stages.estimators.bodyfit.reporting import Fitted
from stages.formats.hands_face import read_hands_face
from stages.formats.motions.face_csv import read_face
from stages.records import BodyModel

BEYOND = 0.5  # s by which film and capture may differ unsaid


def check_face(path: Path, model: BodyModel) -> None:
    """StageError for a file that is no face capture, and for a body without a face that moves."""
    read_face(path)
    rig = read_hands_face(model)
    if rig is None or not len(rig.face_points):
        raise StageError(
            f"the body model {model.name} has no face that moves",
            "leave out `--face`, or `--body-model`: the free body has a face",
        )


def check_alone(path: Path, people: Sequence[int]) -> None:
    """StageError where several `people` are modelled."""
    if len(people) > 1:
        hint = "choose its person with `--person ID`, or leave out `--face`"
        raise StageError(f"{path.name} is the face of one person, and the masks show {len(people)}", hint)


def with_face(job: Job, path: Path, fit: Fitted, times: np.ndarray) -> Fitted:
    """The fit with the face at `times` [F] s, where film and capture begin together; notes what of the file was taken."""
    take = read_face(path)
    job.note("; ".join([f"face: {path.name}", *take.notes]))
    ends = f"{path.name} ends at {take.times[-1]:.1f} s, the film's frames at {times[-1]:.1f} s"
    if times[-1] > take.times[-1] + BEYOND:
        late = int((times > take.times[-1]).sum())
        job.warn(f"{ends}: in {late} of {len(times)} frames the face stays as it was last")
    elif take.times[-1] > times[-1] + BEYOND:
        job.note(f"{ends}: they should begin together")
    return replace(fit, poses=replace(fit.poses, face=between(times, take.times, take.face)))

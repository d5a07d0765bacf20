"""The cameras of a clip whose camera stands still, is taken to, or zooms on its tripod; and what is said of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stages.estimators.cameras.plain import Plain, Views, standing_part
from stages.estimators.cameras.task import GUESSED_FOCAL, Solution, Task, fixed_views
from stages.estimators.cameras.verdict import Footage, NoCameras

WALKED = 3  # frames with cameras apart from each other: who has them walks
HUMAN_ONLY = "film while walking a few steps around the person to get the scene too"


def still(task: Task, facts: dict[str, Any], names: list[str] | None = None) -> Solution:
    """The cameras of a clip whose camera stands still, in all frames or in those of `names`."""
    names = names or task.names
    count, focal = len(names), task.known_focal or GUESSED_FOCAL * task.side
    lens = {"focal_spread_px": round(task.prior.spread * focal, 3)}
    views, focals = fixed_views(count), np.full(count, focal)
    return Solution("static camera", names, views, focals, task.center, 0.0, facts=facts | {"lens": lens})


def stands_still(task: Task, displacement: float, facts: dict[str, Any]) -> Solution:
    """`still`, said to the user, of a clip whose background moves by `displacement` px."""
    task.job.warn(
        f"the camera stands still (the background moves {displacement:.2f} px between frames): "
        f"the clip shows no depth, so only the person is modelled; {HUMAN_ONLY}. If it moved, and a caption or a logo stays in "
        "place: `--set sfm.camera=moving`"
    )
    return still(task, facts)


def zooms(task: Task, footage: Footage, zoom: np.ndarray, facts: dict[str, Any]) -> Solution:
    """The cameras of a clip whose camera stands and zooms by `zoom` [F], NaN in frames that are left out."""
    known = np.isfinite(zoom)
    facts["trouble"] = footage.require(task.job, [known], [])
    found = still(task, facts, [name for name, there in zip(task.names, known, strict=True) if there])
    found.focals = found.focals * zoom[known]
    task.job.warn(
        f"the camera stands still and zooms (its focal length is {zoom[known].min():.2f} to {zoom[known].max():.2f} times "
        f"that of the first frame): the clip shows no depth, so only the person is modelled; {HUMAN_ONLY}"
    )
    return found


def taken_to_stand(task: Task, views: Views, edges: Plain, refusal: NoCameras) -> Solution:
    """`still` where features place no cameras, unless the background shows that the camera moves: then `refusal` is raised.

    So it is where WALKED frames were placed. Of a camera that was bumped, the larger part that stands.
    """
    names, why = task.names, "edges in the background stay where they are, though other parts change"
    if edges.moves:
        shots = standing_part(views)
        names = [] if shots is None else task.names[shots[0] : shots[-1] + 1]
        if len(names) < max(math.ceil(task.min_share * len(task.names)), 2):
            raise refusal
        why = f"it stands in frames {names[0]} to {names[-1]}; the {len(task.names) - len(names)} others are left out"
    elif refusal.placed >= WALKED:
        raise refusal
    elif np.isnan(edges.stays):
        why = "nothing visible in the background shows whether the camera moves"
    task.job.warn(
        f"{refusal.problem}, but the camera is assumed to stand still: {why}. Only the person is modelled; {HUMAN_ONLY}. "
        "If it moved: `--set sfm.camera=moving`"
    )
    return still(task, {"motion": edges.facts()}, names)

"""A training that is to fit into a time: its steps and sizes are chosen before its first step."""

from __future__ import annotations

import math
from collections.abc import Callable

from stages.contract import StageError
from stages.training.calibration import FEWEST, LARGE, LARGE_FROM, SMALL, SMALL_UNDER, short_of
from stages.training.deadline import Deadline
from stages.training.fit import Fit
from stages.training.settings import Params


def chosen_sizes(steps: int, params: Params) -> dict[str, int]:
    """The sizes to change where so many steps at the sizes of `params` fit into the time."""
    if SMALL_UNDER <= steps < LARGE_FROM:
        return {}
    pick, wanted = (min, SMALL) if steps < SMALL_UNDER else (max, LARGE)
    sizes = {name: pick(size, getattr(params, name)) for name, size in wanted.items()}
    return {name: size for name, size in sizes.items() if getattr(params, name) != size}


def fit_into_time(
    fit: Fit, params: Params, deadline: Deadline, rebuilt: Callable[[dict[str, int]], Fit], note: Callable[[str], None]
) -> tuple[Fit, dict[str, int]]:
    """The training with as many steps as fit into the time, and its sizes where they are not those of `params`.

    `fit` has not begun and is rehearsed; where the time calls for other sizes, `rebuilt` makes it with these. StageError
    where the time is too short.
    """
    steps = deadline.start(fit)
    if sizes := chosen_sizes(steps, params):
        fit = rebuilt(sizes)
        steps = deadline.start(fit, 1)  # once: the sizes stay, the steps are fitted into the time again and again
    step = deadline.pace.mean(0.0)
    if steps < FEWEST:
        raise StageError(
            "the time is too short to train on this clip",
            facts=[f"{steps} steps would fit into {params.seconds:.0f} s, {FEWEST} are the least that makes sense"],
            hint=f"give {math.ceil(FEWEST * step - deadline.left)} s more",
        )
    fit.progress.retime(steps)
    caps = f"at most {fit.params.human_cap:,} Gaussians of the person and {fit.params.scene_cap:,} of the scene"
    note(f"{steps:,} steps of {1000 * step:.0f} ms fit into the time, with {caps}")
    if lost := round(short_of(steps), 1):
        note(f"about {lost} dB short of what 10,000 steps reach, going by our phone clip")
    return fit, sizes

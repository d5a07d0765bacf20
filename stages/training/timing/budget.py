"""A training that is to fit into a time: its steps, sizes and effects are chosen before its first step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from stages.training.settings import Params
from stages.training.step.fit import Fit
from stages.training.timing.calibration import (
    CURVE,
    ENOUGH,
    FEWEST,
    LARGE,
    LARGE_FROM,
    SMALL,
    SMALL_UNDER,
    WORTH,
    short_of,
)
from stages.training.timing.deadline import Deadline
from stages.training.timing.effect_gains import effects_of


@dataclass(frozen=True)
class Choice:
    """What a time asked for: settings of the training that are not its own, and effects of the clip that are left out."""

    settings: dict[str, int] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()


def chosen_sizes(steps: int, params: Params) -> dict[str, int]:
    """The sizes to change where so many steps at the sizes of `params` fit into the time."""
    if SMALL_UNDER <= steps < LARGE_FROM:
        return {}
    pick, wanted = (min, SMALL) if steps < SMALL_UNDER else (max, LARGE)
    sizes = {name: pick(size, getattr(params, name)) for name, size in wanted.items()}
    return {name: size for name, size in sizes.items() if getattr(params, name) != size}


def too_dear(effects: Iterable[str], steps: int) -> tuple[str, ...]:
    """The effects that win less, by WORTH, than the steps would that they cost, where `steps` with all of them fit."""
    left_out = []
    for name in effects:
        wins, share = WORTH.get(name, (0.0, 0.0))
        without = int(steps / (1 - share))
        if short_of(steps) - short_of(without) > wins:
            left_out.append(name)
            steps = without
    return tuple(left_out)


def fit_into_time(
    fit: Fit, params: Params, deadline: Deadline, rebuilt: Callable[[Choice], Fit], note: Callable[[str], None]
) -> tuple[Fit, Choice]:
    """The training with as many steps as fit into the time, and what the time asked for besides.

    `fit` has not begun and is rehearsed; where the time calls for other sizes or fewer effects, `rebuilt` makes it so.
    What comes after training gives way first, then effects; FEWEST steps are taken even if they end late.
    """
    steps = deadline.start(fit)
    settings: dict[str, int] = {}
    if steps < ENOUGH:
        deadline.hurry()
        settings = {"curve_points": CURVE} if params.curve_points > CURVE else {}
        deadline.pauses = min(deadline.pauses, CURVE)
        steps = deadline.fitting(0.0)
    sizes, left_out = chosen_sizes(steps, params), too_dear(effects_of(fit), steps)
    choice = Choice(settings | sizes, left_out)
    if sizes or left_out:
        fit = rebuilt(choice)
        steps = deadline.start(fit, 1)  # once: sizes stay, the steps are fitted into the time again and again
    if choice.left_out:
        note(f"effects left out, since more steps gain more: {', '.join(choice.left_out).replace('_', ' ')}")
    step = deadline.pace.mean(0.0)
    if steps < FEWEST:
        late = FEWEST * step - deadline.left
        note(f"{steps} steps would fit into the time, {FEWEST} are the least: it ends about {late:.0f} s late")
        steps = FEWEST
    fit.progress.retime(steps)
    caps = f"at most {fit.params.human_cap:,} Gaussians of the person and {fit.params.scene_cap:,} of the scene"
    note(f"{steps:,} steps of {1000 * step:.0f} ms, with {caps}")
    if lost := round(short_of(steps), 1):
        note(f"about {lost} dB less than after 10,000 steps, judging by our phone clip")
    return fit, choice

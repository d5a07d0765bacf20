"""Measured results of trainings with a time limit, and the sizes they ask for.

Of 21 to 25 November 2026, on two cores of an AMD EPYC without a GPU: the hand-held phone clip of tests/benchmarks
(480x864, 80 frames). Another machine changes the seconds of a step, which are timed anew each time, not these figures;
another clip may need others.
"""

from __future__ import annotations

import math

import numpy as np

SMALL, SMALL_UNDER = {"human_points": 27_500, "human_cap": 28_000, "scene_cap": 50_000, "views_per_decode": 4}, 1200
LARGE, LARGE_FROM = {"human_cap": 60_000, "scene_cap": 160_000}, 9000
"""Sizes where fewer, or more, than so many steps of the settings' own sizes fit into the time."""
FEWEST = 200  # steps; fewer make no person
ENOUGH = 600  # steps; where fewer fit, what comes after training takes its least time first
CURVE = 4  # measurements of accuracy in a training of fewer than ENOUGH steps
PAUSE = 6.0  # full, grown steps that take as long as measuring accuracy, until that has been timed
SHORT_OF = {100: 5.4, 200: 4.0, 300: 2.7, 700: 1.6, 1000: 1.1, 1600: 0.8, 4000: 0.3, 10_000: 0.0}
"""Steps -> dB of the whole picture that a training is short of one of 10,000 steps (docs/lab/2026-11/budgets.md#rates). That 10,000
win 0.3 over 4,000 is a guess. 100 and 200 are as much worse than 400 as in the sweep of the synthetic clip."""

WORTH = {"motion_blur": (0.7, 0.4)}
"""Effect -> dB of the whole picture that its model won in 400 steps where `survey` had found it (effect_models.py), and the
share of a step that it takes (the phone clip, full size). Those not named here are never left out."""


def short_of(steps: int) -> float:
    """About how many dB `steps` are short of 10,000: SHORT_OF, linear in log(steps), clamped at its ends."""
    return float(np.interp(math.log(steps), [math.log(known) for known in SHORT_OF], list(SHORT_OF.values())))

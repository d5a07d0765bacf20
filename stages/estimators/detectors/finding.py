"""The answer of a detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

SHOWN = 3  # frames named with a finding


@dataclass(frozen=True)
class Finding:
    """A measured `value` beside its `threshold`, a `verdict` in a word or two, and the `frames` that show it best.

    `confidence` is 0 where the value is the threshold and where nothing was measured, and 0.75 at half or twice it. `start`
    is where training may begin to learn what was seen: of a shadow the direction [3] to the lamp and the share of light taken.
    """

    value: float | None
    unit: str
    threshold: float
    verdict: str
    called_for: bool
    confidence: float
    frames: tuple[str, ...] = ()
    start: tuple[float, ...] = ()

    def entry(self) -> dict:
        """The finding as survey.json has it, before the settings decide."""
        known = {key: value for key, value in asdict(self).items() if key not in ("called_for", "start")}
        return known | {"frames": list(self.frames)}


def unmeasured(unit: str, threshold: float, why: str) -> Finding:
    """Nothing could be measured, so the effect stays off; `why` says the reason."""
    return Finding(None, unit, threshold, f"unknown: {why}", False, 0.0)


def compare(
    value: float, unit: str, threshold: float, words: tuple[str, str], frames: Sequence[str] = (), also: bool = True
) -> Finding:
    """Called for if `value` > `threshold` and `also` holds; `words` are the verdicts for yes and no. Infinity is no value."""
    if not np.isfinite(value):
        return unmeasured(unit, threshold, "the measurement failed")
    called = bool(value > threshold and also)
    doubt = 0.25 ** abs(np.log2(max(value, 1e-9) / threshold)) if called or value <= threshold else 0.5
    return Finding(
        float(value),
        unit,
        threshold,
        words[0] if called else words[1],
        called,
        round(float(1 - doubt), 2),
        tuple(frames),
    )


def strongest_frames(names: tuple[str, ...], values: np.ndarray) -> list[str]:
    """The SHOWN names with the largest `values` [F], NaN left out, in the clip's order."""
    order = [
        i for i in np.argsort(-np.nan_to_num(values, nan=-np.inf), kind="stable")[:SHOWN] if np.isfinite(values[i])
    ]
    return [names[i] for i in sorted(order)]

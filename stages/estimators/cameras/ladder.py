"""SfM rung by rung: another way to map is tried only while no model is good enough, and the best of all is taken.

No mapper wins on every clip: on real ones the incremental mapper failed where the global one placed every frame, and
the other way round. The global one goes first: on halves and quarters of one real clip it found the same focal length
within 1 %, where the incremental one, in twice the time, was up to 50 % off and stopped short of the best fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

from stages.contract import Job
from stages.estimators.cameras import colmap, colmap_features
from stages.estimators.cameras.colmap import Model

GOOD_SHARE = 0.9  # of the frames: a model with fewer is not good enough to stop
MAX_ERROR = 2.0  # px: a model that is off by more on average is not believed
FEW_POINTS = 100  # with fewer, poses hang in the air and are no model: a turn mapped as a walk had 0, at 0 px error
SANE_FOCAL = (0.3, 3.0)  # of the longer side; a phone has 0.75 to 2
MORE = 10  # frames that follow, with which each is matched when the first matches did not do
SECONDS = 120  # about how long a mapper may take; it stops with what it has
FIRST, LAST = 60, 85  # per cent of the stage's progress between which the rungs lie


@dataclass(frozen=True)
class Matched:
    """`count` frames with verified matches in `database`, `side` px at the longer side, ready to be mapped.

    `need` frames must get a pose; `overlap` is the number of following frames that each was matched with.
    """

    database: Path
    images: Path
    scratch: Path
    count: int
    side: int
    need: int
    overlap: int
    fixed_focal: bool

    def doubts(self, model: Model) -> list[str]:
        """What makes a model look unreliable, in words."""
        found = []
        if not self.fixed_focal and not SANE_FOCAL[0] < model.focal / self.side < SANE_FOCAL[1]:
            found.append(f"a focal length of {model.focal:.0f} px for frames of {self.side} px")
        if model.error > MAX_ERROR:
            found.append(f"points {model.error:.1f} px off")
        return found

    def usable(self, model: Model) -> bool:
        """Whether enough frames have a pose, and nothing makes the model look unreliable."""
        return model.registered >= self.need and not self.doubts(model)

    def good(self, model: Model) -> bool:
        """Whether the model is so good that no other rung is tried."""
        return model.registered >= GOOD_SHARE * self.count and self.usable(model)

    def rank(self, model: Model) -> tuple:
        """Greater is better: usable, then more frames, then the smaller error."""
        return self.usable(model), model.registered, -model.error


@dataclass(frozen=True)
class Rung:
    """One way of mapping that was tried, its models, the best first, and the time it took."""

    how: str
    models: list[Model]
    seconds: float

    def facts(self) -> dict:
        """What sfm.json says of it; no seconds, so that the same clip gives the same bytes."""
        return {"how": self.how, "models": [model.facts() for model in self.models]}

    def describe(self, matched: Matched) -> str:
        """In a few words: how many frames the best model has, and what makes it look unreliable."""
        if not self.models:
            return f"{self.how}: no model of {FEW_POINTS} points in {self.seconds:.0f} s"
        best = self.models[0]
        words = f"{self.how}: {best.registered} of {matched.count} frames in {self.seconds:.0f} s"
        doubts = matched.doubts(best)
        return f"{words}, looks unreliable ({', '.join(doubts)})" if doubts else words


Mapping = Callable[[Matched, Path, Callable[[], None]], list[Model]]


def by_global(matched: Matched, out: Path, placed: Callable[[], None]) -> list[Model]:
    """COLMAP's global mapper (GLOMAP)."""
    return colmap.map_global(matched.database, matched.images, out, matched.count, matched.fixed_focal, SECONDS)


def by_incremental(matched: Matched, out: Path, placed: Callable[[], None], close: bool = False) -> list[Model]:
    """COLMAP's incremental mapper; `close` lets it start with two frames that lie close together."""
    return colmap.map_incremental(matched.database, matched.images, out, matched.fixed_focal, placed, SECONDS, close)


def after_matching(mapping: Mapping, matched: Matched, out: Path, placed: Callable[[], None]) -> list[Model]:
    """`mapping` after each frame is matched with more later frames; pairs matched before stay."""
    colmap_features.match(matched.database, max(MORE, 2 * matched.overlap), growing=False, side=matched.side)
    return mapping(matched, out, placed)


RUNGS: dict[str, Mapping] = {
    "global mapper": by_global,
    "incremental mapper": by_incremental,
    "incremental mapper, small first angle": partial(by_incremental, close=True),
    "global mapper, more pairs": partial(after_matching, by_global),
    "incremental mapper, more pairs": partial(after_matching, by_incremental),
}


def climb(job: Job, matched: Matched, most: int | None = None) -> list[Rung]:
    """Try RUNGS in order, `most` of them, until a model is good enough; each is noted, unless the first is good enough."""
    tried: list[Rung] = []
    for how, mapping in list(RUNGS.items())[:most]:
        if tried:
            job.note(f"{tried[-1].describe(matched)}; trying the {how}, {SECONDS} s at most", at_once=True)
        placed = _counter(job, len(tried), matched.count)
        began = perf_counter()
        made = mapping(matched, matched.scratch / f"rung{len(tried)}", placed)
        models = [model for model in made if model.points >= FEW_POINTS]
        ranked = sorted(models, key=matched.rank, reverse=True)
        tried.append(Rung(how, ranked, perf_counter() - began))
        if any(matched.good(model) for model in models):
            break
    if len(tried) > 1:
        job.note(tried[-1].describe(matched))
    return tried


def best_rung(matched: Matched, rungs: list[Rung]) -> Rung:
    """The rung with the best model; of equals the first, and any if none has a model."""
    return max(rungs, key=lambda rung: matched.rank(rung.models[0]) if rung.models else ())


def _counter(job: Job, rung: int, count: int) -> Callable[[], None]:
    """To be called for each frame placed on `rung`; a mapper may place a frame more than once."""
    low, high = (FIRST + (LAST - FIRST) * step // len(RUNGS) for step in (rung, rung + 1))
    done = 0

    def placed() -> None:
        nonlocal done
        done = min(done + 1, count)
        job.progress(low + (high - low) * done // count, 100, frames=done)

    return placed

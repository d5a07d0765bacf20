"""split.json of the stage calibrated: which frames of a data set are trained on and which are measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.formats.facts import SplitFacts, not_as_written, read_facts, write_facts
from stages.records import Split

EVERY_FIFTH = "Every 5th registered frame is held out."
HELD_OUT_EVERY, HELD_OUT_FIRST = 5, 2


def write_split(path: Path, rule: str, frames: dict[str, tuple[str, int]]) -> None:
    """Write `frames`: name -> (train, heldout or unused; moment)."""
    rows = {name: {"split": split, "moment": moment} for name, (split, moment) in frames.items()}
    write_facts(path, {"rule": rule, "frames": rows})


def every_fifth(count: int) -> Split:
    """The split of so many frames where nothing else says which are held out; each is a moment of its own."""
    at = np.arange(count)
    heldout = at % HELD_OUT_EVERY == HELD_OUT_FIRST
    return Split(~heldout, heldout, at, EVERY_FIFTH)


def read_split(path: Path, names: tuple[str, ...]) -> Split:
    """The split of the frames `names`; without a file every 5th is held out and all others are trained on."""
    if not path.exists():
        return every_fifth(len(names))
    found = read_facts(path, SplitFacts)
    if missing := [name for name in names if name not in found.frames]:
        raise not_as_written(path, f"frames has no {missing[0]}")
    rows = [found.frames[name] for name in names]
    kind = np.array([row.split for row in rows], np.str_)
    moments = np.array([row.moment for row in rows], np.int64)
    return Split(kind == "train", kind == "heldout", moments, found.rule)

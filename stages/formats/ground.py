"""ground.json of the smpl stage: the floor on which the person stood."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from stages.formats.facts import Facts, Number, Whole, not_as_written, read_facts, write_facts
from stages.records import Ground

Axis = tuple[Number, Number, Number]


class GroundFacts(Facts):
    """The keys of ground.json, those of `records.Ground`."""

    point: Axis
    up: Axis
    ahead: Axis
    metres: Number
    height_error: Number
    tilt_error: Number
    points: Whole
    how: str


def write_ground(path: Path, ground: Ground) -> None:
    """Write the floor as JSON; the numbers come back as they are."""
    axes = {name: getattr(ground, name).tolist() for name in ("point", "up", "ahead")}
    write_facts(path, asdict(ground) | axes)


def read_ground(path: Path) -> Ground:
    """Read a ground.json; StageError where it is missing or is not a plane with a way ahead."""
    facts = read_facts(path, GroundFacts)
    axes = {name: np.array(getattr(facts, name), np.float64) for name in ("point", "up", "ahead")}
    lengths = np.linalg.norm([axes["up"], axes["ahead"]], axis=1)
    if np.abs(lengths - 1).max() > 1e-3 or abs(axes["up"] @ axes["ahead"]) > 1e-3:
        fact = f"up {list(facts.up)} and ahead {list(facts.ahead)} are not of length 1 and square to each other"
        raise not_as_written(path, fact)
    return Ground(**facts.model_dump() | axes)

"""How long stages will take on this machine: from its earlier runs, else from measured ones. Only forecasts depend on it."""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from statistics import median
from typing import NamedTuple

from pydantic import NonNegativeFloat, PositiveFloat, TypeAdapter, ValidationError

from hugs_cli import busy
from hugs_cli.cache import whole
from hugs_cli.cache.child import processors
from hugs_cli.cache.freshness import Session, Verdict
from hugs_cli.cache.workspace import read_json
from hugs_cli.pipelines import Stage
from hugs_cli.words import duration

STAGE_START = 2.5
"""Seconds from the end of a stage to the start of the next, libraries loaded, and of a stage of which nothing is known."""
USUAL = {"frames": 4.0, "masks": 41.0, "sfm": 35.0, "smpl": 40.0, "survey": 14.0, "train": 600.0, "export": 30.0,
         "render": 33.0, "evaluate": 90.0}  # fmt: skip
"""Seconds of the stages of `default`. The phone clip, 2 cores, November 2026."""
FINISHING = 300
"""Steps that take as long as what follows the last one."""
KEPT, ASKED = 400, 5  # rows in the file, and the last ones of a stage that a guess is made from
SHORT = 2.0  # s; shorter stages tell nothing
WORTH = 10.0  # s; of a shorter run it is not found out how busy the machine is
OFF = {0: 2.0, 1: 1.6, 2: 1.4}
"""Earlier runs -> factor within which a guess is held to be; of more it is FEW."""
FEW = 1.25


class Sizes(NamedTuple):
    """What the time of a stage depends on."""

    frames: PositiveFloat = 80
    pixels: PositiveFloat = 480 * 864
    steps: NonNegativeFloat = 1400


class Row(NamedTuple):
    """One finished stage: `seconds` as if nothing else had run."""

    stage: str
    module: str
    pipeline: str
    device: str
    processors: int
    sizes: Sizes
    seconds: PositiveFloat


class Guess(NamedTuple):
    """Seconds, and the factor within which they are held to be."""

    seconds: float
    off: float


def work(stage: str, sizes: Sizes) -> float:
    """How many times as long a stage takes as with USUAL sizes."""
    usual = Sizes()
    frames, drawn = sizes.frames / usual.frames, (sizes.pixels / usual.pixels) ** 0.5
    match stage:
        case "train":
            return drawn * (sizes.steps + FINISHING) / (usual.steps + FINISHING)
        case "render" | "evaluate":
            return drawn * frames
        case "export":
            return 1.0
    return frames


def sizes_of(session: Session, picked: bool) -> Sizes:
    """The sizes of a clip; until its frames are `picked` those that are asked for."""
    stages = session.pipeline.stages
    asked = stages["frames"].params.model_dump() if "frames" in stages else {}
    side, steps = (
        asked.get("max_side", 0),
        stages["train"].params.model_dump().get("steps", 0) if "train" in stages else 0,
    )
    sizes = Sizes(asked.get("count") or Sizes().frames, side * side * 9 / 16 or Sizes().pixels, steps)
    if picked:
        facts = read_json(session.workspace.links / "frames" / "frames.json")
        with suppress(KeyError, TypeError):
            sizes = Sizes(len(facts["frames"]) or sizes.frames, facts["width"] * facts["height"] or sizes.pixels, steps)
    return sizes


@cache
def free() -> float:
    """Share of its processors that the machine has for this process, as it was at first."""
    return busy.share()


def folder() -> Path:
    """Where the times of machines are kept."""
    return Path(os.environ.get("HUGS_CACHE") or Path.home() / ".cache" / "hugs") / "times"


def file() -> Path:
    """That of this machine."""
    return folder() / f"{re.sub(r'[^A-Za-z0-9_-]+', '.', platform.node()) or 'machine'}.json"


def rows() -> list[Row]:
    """What this machine has run, in order; nothing where the file cannot be read."""
    try:
        return _form().validate_python(read_json(file()).get("rows", []))
    except ValidationError:
        return []


@cache
def _form() -> TypeAdapter[list[Row]]:
    return TypeAdapter(list[Row])


def learn(session: Session, stage: Stage, seconds: float, device: str) -> None:
    """Keep how long a stage took; not of a training that was fitted into a time."""
    if seconds < SHORT or stage.params.model_dump().get("seconds"):
        return
    own = Row(stage.name, stage.module, session.pipeline.name, device, processors(), sizes_of(session, True), seconds)
    with suppress(OSError):  # a full disk: the next guess is a little worse
        folder().mkdir(parents=True, exist_ok=True)
        kept = [*rows(), own._replace(seconds=seconds * free())][-KEPT:]
        whole.replace(file(), json.dumps({"rows": [row._asdict() | {"sizes": row.sizes._asdict()} for row in kept]}))


@dataclass(frozen=True)
class Times:
    """What this machine's earlier runs on a device tell."""

    rows: list[Row]

    @cached_property
    def by_module(self) -> dict[str, list[Row]]:
        """The rows of each module."""
        return {
            module: [row for row in self.rows if row.module == module] for module in {row.module for row in self.rows}
        }

    @cached_property
    def pace(self) -> float:
        """How many times as long as USUAL the stages took that were run."""
        known = [row for row in self.rows if row.stage in USUAL and row.module == f"stages.{row.stage}"]
        return median(row.seconds / USUAL[row.stage] / work(row.stage, row.sizes) for row in known) if known else 1.0

    def alone(self, session: Session, stage: Stage, sizes: Sizes) -> Guess:
        """Of one stage, if nothing else ran."""
        same = self.by_module.get(stage.module, [])
        same = [row for row in same if row.pipeline == session.pipeline.name] or same
        rates = [row.seconds / work(stage.name, row.sizes) for row in same[-ASKED:]]
        if not rates and stage.name not in USUAL:
            return Guess(STAGE_START, OFF[0])
        rate = median(rates) if rates else USUAL[stage.name] * self.pace
        return Guess(rate * work(stage.name, sizes), OFF.get(len(rates), FEW))

    def forecast(self, session: Session, todo: Iterable[str], now: bool = True) -> dict[str, Guess]:
        """Of stages to do, in their order; as busy as the machine is `now`, or as if nothing else ran."""
        todo = list(todo)
        sizes, stages = sizes_of(session, "frames" not in todo), session.pipeline.stages
        found = {name: self.alone(session, stages[name], sizes) for name in todo}
        share = free() if now and sum(one.seconds for one in found.values()) > WORTH else 1.0
        return {name: Guess(one.seconds / share, one.off) for name, one in found.items()}


def here(device: str) -> Times:
    """The times of this machine, with 'cpu' or 'cuda'."""
    count = processors()
    return Times([row for row in rows() if (row.device, row.processors) == (device, count)])


def expected(
    session: Session, stages: Iterable[Stage], done: Mapping[str, Verdict], forced: frozenset[str], device: str
) -> list[tuple[str, Guess]]:
    """What a run of `stages` would make, in order, as busy as the machine is now; results of other stages are `done`."""
    found = dict(done)
    for stage in stages:
        found[stage.name] = session.verdict(stage, found, stage.name in forced)
    todo = [stage.name for stage in stages if not found[stage.name].fresh]
    return list(here(device).forecast(session, todo).items())


def total(guesses: Iterable[Guess]) -> Guess:
    """All of them, one after the other."""
    guesses = list(guesses)
    seconds = sum(one.seconds for one in guesses)
    return Guess(seconds, sum(one.seconds * one.off for one in guesses) / seconds if seconds else 1.0)


def said(guess: Guess) -> str:
    """'about 14m 10s (between 9m 27s and 21m 15s)'."""
    low, high = guess.seconds / guess.off, guess.seconds * guess.off
    return f"about {duration(guess.seconds)} (between {duration(low)} and {duration(high)})"

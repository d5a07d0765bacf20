"""How long stages will take on this machine: from its earlier runs, else from measured ones. Only forecasts depend on it."""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
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
from stages.contract import load_stage

STAGE_START = 2.5
"""Seconds from the end of a stage to the start of the next, libraries loaded, and of a stage of which nothing is known."""
LOADING = 1.0  # s of a stage that do not depend on sizes
FINISHING, SETTLING = 100, 200  # steps that take as long as what follows the last one, and settling in it, at most
KEPT, ASKED = 400, 5  # rows in the file, and the last ones of a stage that a guess is made from
SHORT = 2.0  # s; shorter stages tell nothing
SMALL = 0.04  # of `default`'s work: nor does less, as in tests; `ci` of the synthetic clip has 0.06
LEAST = 250  # steps of a training that takes as long as the shortest one, with what it times and the least after it
WORTH = 10.0  # s; of a shorter run it is not found out how busy the machine is
OFF = {0: 2.0, 1: 1.6, 2: 1.4}
"""Earlier runs -> factor within which a guess is held to be; of more it is FEW."""
FEW = 1.25


class Sizes(NamedTuple):
    """What the time of a stage depends on."""

    frames: PositiveFloat = 80
    pixels: PositiveFloat = 480 * 864
    steps: NonNegativeFloat = 1400
    moves: bool = True
    """Whether the camera does."""
    scene: bool = True
    """Whether there is a scene, or the person alone."""


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
    """Seconds, the factor within which they are held to be, and the seconds of these in which kernels are compiled."""

    seconds: float
    off: float
    compiling: float = 0.0

    @property
    def running(self) -> float:
        """Seconds without `compiling`."""
        return self.seconds - self.compiling


USUAL: dict[str, tuple[Sizes, dict[str, float]]] = {
    "default": (Sizes(), {"frames": 2.4, "masks": 28.8, "sfm": 20.4, "smpl": 30.6, "survey": 10.2, "train": 272.4,
                          "export": 16.2, "render": 15.0, "evaluate": 52.2}),
    "preview": (Sizes(20, 267 * 480, 200), {"frames": 1.1, "masks": 6.2, "sfm": 2.8, "smpl": 11.7, "survey": 4.9,
                                            "train": 18.2, "export": 1.9, "render": 3.4, "evaluate": 2.2}),
}  # fmt: skip
"""Pipeline -> sizes, and seconds of its stages; others are as `default`. The phone clip, 2 idle cores of Zen 4, November 2026."""
TOGETHER, USUALLY = {"train": 0.9, "masks": 0.7, "evaluate": 0.7, "smpl": 0.1, "survey": 0.2}, 0.4
"""Share of its time in which a stage uses all processors: `preview` beside two busy processes, 2 cores of Zen 4, November 2026."""
ALONE, STANDING = {"train": 0.34, "render": 0.5, "evaluate": 0.4}, 0.04
"""Stage -> time where the person is alone, of that with a scene; time of `sfm` where the camera stands, of that where it moves.
Three clips of the table, 2 idle cores of Zen 4, November 2026."""
MOVES, STANDS = "moving", "static camera"  # what sfm.json says of a camera; one that only turns shows no scene either
COMPILING = 34.0  # s in which a training compiles kernels; `preview`, then again, 2 idle cores of Zen 4, November 2026


def work(stage: str, sizes: Sizes) -> float:
    """How many times as long a stage takes as with the sizes of `default`."""
    usual = Sizes()
    frames, drawn = sizes.frames / usual.frames, (sizes.pixels / usual.pixels) ** 0.5
    shown = drawn if sizes.scene else ALONE.get(stage, 1.0) * drawn**0.5
    match stage:
        case "train":
            return shown * _steps(sizes.steps) / _steps(usual.steps)
        case "render" | "evaluate":
            return shown * frames
        case "sfm" if not sizes.moves:
            return STANDING * frames
        case "export":
            return 1.0
    return frames


def alike(stage: str, one: Sizes, other: Sizes) -> bool:
    """Whether a stage does the same work with both sizes, more or less of it."""
    if stage == "sfm":
        return one.moves == other.moves
    return one.scene == other.scene or stage not in ALONE


def _steps(steps: float) -> float:
    """Steps, and those that take as long as what follows the last one, which is less where they are few."""
    return steps + FINISHING + min(SETTLING, steps / 5)


def usual(pipeline: str, stage: str, sizes: Sizes) -> float:
    """Seconds of a stage on the machine of USUAL."""
    known, seconds = USUAL.get(pipeline.partition(".")[0], USUAL["default"])
    more = seconds.get(stage, STAGE_START) - LOADING
    return LOADING + more * work(stage, sizes) / work(stage, known)


def sizes_of(session: Session, todo: Collection[str]) -> Sizes:
    """The sizes of a clip. While frames are `todo` those that are asked for, as far as the film has them; while cameras are, they
    move as the film shows at a glance.
    """
    stages, links = session.pipeline.stages, session.workspace.links
    steps = stages["train"].params.model_dump().get("steps", 0) if "train" in stages else 0
    sizes, picks = Sizes(steps=steps), stages.get("frames")
    if picks is not None and (expected := load_stage(picks.module).sizes) is not None:
        sizes = Sizes(*expected(picks.params, session.video), steps)
    if "frames" not in todo:
        facts = read_json(links / "frames" / "frames.json")
        with suppress(KeyError, TypeError):
            sizes = Sizes(len(facts["frames"]) or sizes.frames, facts["width"] * facts["height"] or sizes.pixels, steps)
    asked = stages["survey"].params.model_dump().get("scene") if "survey" in stages else None
    if "sfm" in todo:
        motion = STANDS if picks is not None and not seems_to_move(picks.module, session.video) else MOVES
    else:
        motion = read_json(links / "sfm" / "sfm.json").get("verdict", MOVES)
    return sizes._replace(moves=motion != STANDS, scene=motion == MOVES and asked != "never")


@cache
def seems_to_move(module: str, video: Path) -> bool:
    """Whether the camera does, by what the stage knows that picks frames; looked at once."""
    return (moves := load_stage(module).moves) is None or moves(video)


@cache
def free() -> tuple[float, float]:
    """`busy.shares`, measured once."""
    return busy.shares()


def slowed(stage: str) -> float:
    """How many times as long a stage takes now as on the idle machine."""
    one, every = free()
    share = TOGETHER.get(stage, USUALLY)
    return share / every + (1 - share) / one


def folder() -> Path:
    """Where the times of machines are kept."""
    return Path(os.environ.get("HUGS_CACHE") or Path.home() / ".cache" / "hugs") / "times"


def file() -> Path:
    """That of this machine."""
    return folder() / f"{re.sub(r'[^A-Za-z0-9_-]+', '.', platform.node()) or 'machine'}.json"


def kept() -> list[Row]:
    """Stages that this machine ran, in order; none where the file cannot be read."""
    try:
        return _form().validate_python(read_json(file()).get("rows", []))
    except ValidationError:
        return []


@cache
def _form() -> TypeAdapter[list[Row]]:
    return TypeAdapter(list[Row])


def learn(session: Session, stage: Stage, seconds: float, device: str, compiling: float = 0.0) -> None:
    """Keep how long a stage took, without the seconds in which it was `compiling`; not of a short or a small one, nor of a
    training that was fitted into a time.
    """
    if seconds - compiling < SHORT or stage.params.model_dump().get("seconds"):
        return
    sizes = sizes_of(session, ())
    if work(stage.name, sizes._replace(moves=True, scene=True)) < SMALL:
        return
    alone = (seconds - compiling) / slowed(stage.name)
    row = Row(stage.name, stage.module, session.pipeline.name, device, processors(), sizes, alone)
    with suppress(OSError):  # a full disk: the next guess is a little worse
        folder().mkdir(parents=True, exist_ok=True)
        plain = [one._asdict() | {"sizes": one.sizes._asdict()} for one in [*kept(), row][-KEPT:]]
        whole.replace(file(), json.dumps({"rows": plain}))


@dataclass(frozen=True)
class Times:
    """What this machine's earlier runs on a device tell."""

    rows: list[Row]
    device: str = "cpu"

    @cached_property
    def by_module(self) -> dict[str, list[Row]]:
        """The rows of each module."""
        return {
            module: [row for row in self.rows if row.module == module] for module in {row.module for row in self.rows}
        }

    @cached_property
    def pace(self) -> float:
        """How many times as long as is USUAL the stages took that were run."""
        return median([_slow(row) for row in self.rows if row.module == f"stages.{row.stage}"] or [1.0])

    def compiling(self, stage: Stage) -> float:
        """Seconds in which a stage compiles kernels that are not there yet."""
        compiled = load_stage(stage.module).compiled
        return 0.0 if compiled is None or self.device != "cpu" or compiled() else COMPILING * self.pace

    def alone(self, session: Session, stage: Stage, sizes: Sizes) -> Guess:
        """Of one stage, if nothing else ran and its kernels are compiled."""
        name, same = session.pipeline.name, self.by_module.get(stage.module, [])
        same = [row for row in same if row.pipeline == name] or same
        same = ([row for row in same if alike(stage.name, row.sizes, sizes)] or same)[-ASKED:]
        slow = median(map(_slow, same)) if same else self.pace
        return Guess(slow * usual(name, stage.name, sizes), OFF.get(len(same), FEW))

    def forecast(
        self, session: Session, todo: Iterable[str], first: bool = True, over: Collection[str] = ()
    ) -> dict[str, Guess]:
        """Of stages to do, in their order, as busy as the machine is now. `first`: no other run compiles their kernels before;
        `over`: those whose results are there by now, and show the clip's sizes.
        """
        todo = list(todo)
        sizes, stages = sizes_of(session, {*todo} - {*over}), session.pipeline.stages
        found = {name: self.alone(session, stages[name], sizes) for name in todo}
        if first:
            more = {name: self.compiling(stages[name]) for name in todo}
            found = {name: Guess(one.seconds + more[name], one.off, more[name]) for name, one in found.items()}
        if sum(one.seconds for one in found.values()) <= WORTH:
            return found
        slow = {name: slowed(name) for name in found}
        return {
            name: Guess(slow[name] * one.seconds, one.off, slow[name] * one.compiling) for name, one in found.items()
        }

    def again(self, session: Session, todo: Sequence[str]) -> dict[str, Guess]:
        """The same when the first of them has ended, if that showed other sizes than were expected; else nothing."""
        if sizes_of(session, todo[1:]) == sizes_of(session, todo):
            return {}
        return self.forecast(session, todo, over=todo[:1])


def _slow(row: Row) -> float:
    return row.seconds / usual(row.pipeline, row.stage, row.sizes)


def here(device: str) -> Times:
    """The times of this machine, with 'cpu' or 'cuda'."""
    count = processors()
    return Times([row for row in kept() if (row.device, row.processors) == (device, count)], device)


def expected(
    session: Session, stages: Iterable[Stage], done: Mapping[str, Verdict], forced: frozenset[str], known: Times
) -> list[tuple[str, Guess]]:
    """What a run of `stages` would make, in order, as busy as the machine is now; results of other stages are `done`."""
    found = dict(done)
    for stage in stages:
        found[stage.name] = session.verdict(stage, found, stage.name in forced)
    todo = [stage.name for stage in stages if not found[stage.name].fresh]
    return list(known.forecast(session, todo).items())


def total(guesses: Iterable[Guess]) -> Guess:
    """All of them, one after the other."""
    guesses = list(guesses)
    seconds = sum(one.seconds for one in guesses)
    off = sum(one.seconds * one.off for one in guesses) / seconds if seconds else 1.0
    return Guess(seconds, off, sum(one.compiling for one in guesses))


def said(guess: Guess) -> str:
    """'about 14m 10s (between 9m 27s and 21m 15s)', and how much of it only a first run takes."""
    low, high = guess.seconds / guess.off, guess.seconds * guess.off
    once = f", {duration(guess.compiling)} of it to compile kernels, once" if guess.compiling else ""
    return f"about {duration(guess.seconds)} (between {duration(low)} and {duration(high)}){once}"

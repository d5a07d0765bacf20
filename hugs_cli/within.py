"""`hugs run VIDEO --within 10m`: run the missing stages, and train for the time that remains."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace
from typing import Any

from hugs_cli.cache import engine
from hugs_cli.cache.engine import Ran
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.workspace import Workspace, read_json, write_json
from hugs_cli.console import Console
from hugs_cli.pipelines import Stage, UsageError
from hugs_cli.studies.calibration import STAGE_START
from hugs_cli.studies.comparison import Quiet
from hugs_cli.words import duration
from stages.contract import load_stage

TIME = re.compile(r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+)s)?")
CHOSEN = "within.json"  # in the pipeline's folder: the chosen settings, for a run that was cut short
SHORT = 300  # seconds; if less is left, stages take their `SHORTER` settings


Chosen = dict[str, dict[str, Any]]
"""Settings by stage."""


def seconds_of(text: str) -> int:
    """'90s', '10m', '1h30m' in seconds; UsageError for anything else and for no time at all."""
    found = TIME.fullmatch(text.strip())
    hours, minutes, seconds = (int(part or 0) for part in found.groups()) if found else (0, 0, 0)
    total = 3600 * hours + 60 * minutes + seconds
    if not total:
        raise UsageError(f"--within {text} is not a time", "write it as 10m, 90s or 1h30m")
    return total


@dataclass(frozen=True)
class Promise:
    """A run within a time. Its results lie beside the pipeline's own, under a name like `default.10m`."""

    session: Session
    wanted: list[str]
    seconds: int

    def keep(self, forced: frozenset[str], device: str, console: Console) -> tuple[list[Ran], dict[str, Any]]:
        """Run the stages before training, train for the time that remains, and run the rest.

        Returns the stages, and the time promised and taken, in seconds. A run that was cut short goes on with the
        settings it had chosen, and a finished training is kept.
        """
        began = time.monotonic()
        before = self._before()
        made = engine.run(self.session, before, forced & set(before), device, console)
        place = self.session.workspace.links / CHOSEN
        chosen = read_json(place)
        if "train" in forced or not self._begun(chosen):
            left = self.seconds - (time.monotonic() - began) - STAGE_START * (len(self.wanted) - len(before))
            chosen = self._choose(left)
            write_json(place, chosen)
            console.say(f"{duration(chosen['train']['seconds'])} are left for training and the stages after it")
            if left < SHORT:
                console.say(
                    "that is short: films are shorter, accuracy is measured less often, and held-out poses are not fitted"
                )
        else:
            console.say("continuing the training that was begun for this time")
        ran = engine.run(with_settings(self.session, chosen), self.wanted, forced - set(before), device, Quiet())
        ran = [*made, *(one for one in ran if one.stage not in before)]
        took = time.monotonic() - began
        off = 100 * (took / self.seconds - 1)
        console.say(f"promised {duration(self.seconds)}, took {duration(took)} ({off:+.0f} %)")
        return ran, {"promised": self.seconds, "took": round(took, 1), "settings": chosen}

    def _begun(self, chosen: dict[str, Any]) -> bool:
        """Whether training with the settings chosen before is finished, or was cut short."""
        if not is_chosen(chosen):
            return False
        session = with_settings(self.session, chosen)
        verdict = session.verdicts(session.pipeline.upstream(["train"]))["train"]
        return verdict.fresh or (
            verdict.recipe is not None and session.workspace.part("train", verdict.recipe.key).is_dir()
        )

    def _choose(self, left: float) -> Chosen:
        """The settings, by stage, for a run with so many seconds left."""
        chosen: Chosen = {"train": {}}
        for name, stage in self.session.pipeline.stages.items() if left < SHORT else ():
            own = stage.params.model_dump()
            if shorter := load_stage(stage.module).shorter:
                chosen[name] = {setting: min(own[setting], most) for setting, most in shorter.items()}
        steps = self._steps_after(with_settings(self.session, chosen).pipeline.stages)
        chosen["train"] |= {"seconds": round(max(left, 1.0), 1), "reserve": round(steps, 1)}
        return chosen

    def _steps_after(self, stages: dict[str, Stage]) -> float:
        """The cost of all that follows the last step of training, in training steps."""
        folders = {name: self.session.workspace.links / name for name in self._before()}
        costs = ((stages[name].params, load_stage(stages[name].module).cost) for name in self.wanted)
        return sum(cost(params, folders) for params, cost in costs if cost)

    def _before(self) -> list[str]:
        """The stages before training, in running order."""
        return [name for name in self.session.pipeline.upstream(["train"]) if name != "train"]

    def last_session(self) -> Session:
        """The session with the settings of the last run of this promise, if there was one."""
        chosen = read_json(self.session.workspace.links / CHOSEN)
        return with_settings(self.session, chosen) if is_chosen(chosen) else self.session


def promise(session: Session, stages: list[str] | None, text: str) -> Promise:
    """The promise to bring `stages` (all if None) up to date within a time like '10m'; UsageError for runs that cannot."""
    seconds = seconds_of(text)
    wanted = session.pipeline.upstream(stages or session.pipeline.stages)
    if "train" not in wanted or "seconds" not in type(session.pipeline.stages["train"].params).model_fields:
        raise UsageError("--within is for runs that train", "leave it out, or name train or a stage after it")
    if not getattr(session.pipeline.stages["train"].params, "joint", True):
        raise UsageError("--within is for trainings of person and scene together", "leave out train.joint, or --within")
    return Promise(beside(session, text.strip()), wanted, seconds)


def beside(session: Session, text: str) -> Session:
    """The session of `default.10m`, given that of `default`."""
    name = f"{session.pipeline.name}.{text}"
    place = Workspace(session.video, session.workspace.work, name)
    return replace(session, workspace=place, pipeline=replace(session.pipeline, name=name))


def with_settings(session: Session, chosen: Chosen) -> Session:
    """The session with the chosen settings."""
    own = session.pipeline.stages
    given = {n: replace(own[n], params=own[n].params.model_copy(update=s)) for n, s in chosen.items() if n in own}
    return replace(session, pipeline=replace(session.pipeline, stages={**own, **given}))


def is_chosen(chosen: dict[str, Any]) -> bool:
    """Whether within.json was read and holds the chosen settings."""
    train = chosen.get("train")
    return (
        isinstance(train, dict)
        and {"seconds", "reserve"} <= set(train)
        and all(isinstance(s, dict) for s in chosen.values())
    )


def last_promise(session: Session, text: str) -> Session:
    """The session of `--pipeline default.10m`, with the settings of its run; UsageError if there was none."""
    session = beside(session, text)
    chosen = read_json(session.workspace.links / CHOSEN)
    if not is_chosen(chosen):
        base = session.pipeline.name.rpartition(".")[0]
        raise UsageError(
            f"no run of pipeline {base} within {text}", f"`hugs run VIDEO --pipeline {base} --within {text}`"
        )
    return with_settings(session, chosen)


def is_time(text: str) -> bool:
    """Whether `text` is a time, as in '10m'."""
    return bool(text and TIME.fullmatch(text))

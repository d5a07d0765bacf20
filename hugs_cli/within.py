"""`hugs run VIDEO --within 10m`: run the missing stages, and train for the time that remains."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hugs_cli import times
from hugs_cli.cache import engine
from hugs_cli.cache.engine import Ran
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.held import holding
from hugs_cli.cache.workspace import Workspace, read_json, write_json
from hugs_cli.console import Console
from hugs_cli.countdown import Countdown
from hugs_cli.device import device_of
from hugs_cli.pipelines import Stage, UsageError
from hugs_cli.times import LEAST, STAGE_START
from hugs_cli.words import duration
from stages.contract import load_stage

TIME = re.compile(r"(?:([0-9]{1,6})h)?(?:([0-9]{1,6})m)?(?:([0-9]{1,6})s)?")
CHOSEN = "within.json"  # in the pipeline's folder: the chosen settings, for a run that was cut short
SLACK = 0.02  # of the time, that what follows training may be guessed to be late before it is made shorter


Chosen = dict[str, dict[str, Any]]
"""Settings by stage."""


def seconds_of(text: str) -> int:
    """'90s', '10m', '1h30m' in seconds; UsageError for anything else and for no time at all."""
    found = TIME.fullmatch(text.strip())
    hours, minutes, seconds = (int(part or 0) for part in found.groups()) if found else (0, 0, 0)
    total = 3600 * hours + 60 * minutes + seconds
    if not total:
        raise UsageError(f"--within {text[:40]} is not a time", "write it as 10m, 90s or 1h30m")
    return total


@dataclass(frozen=True)
class Promise:
    """A run within a time. Its results lie beside the pipeline's own, under a name like `default.10m`."""

    session: Session
    wanted: list[str]
    seconds: int

    def keep(self, forced: frozenset[str], device: str, console: Console) -> tuple[list[Ran], dict[str, Any]]:
        """Run the stages before training, train for the time that remains, and run the rest in what is left then.

        Returns the stages, and the time promised, guessed and taken, in seconds. Where the guess is that the time will not
        do, that is said before the first stage; the run goes on and ends late. A run that was cut short goes on with the
        settings it had chosen, and a finished training is kept.
        """
        began = time.monotonic()
        before, after = self._before(), self._after()
        place = self.session.workspace.links / CHOSEN
        chosen = read_json(place)
        begun = "train" not in forced and self._begun(chosen)
        guess = self._guess(forced, begun, device_of(device)[0], console)
        console.opening.append(lambda sure: self._say_what_does_not_fit(guess, console))
        later = ["train", *after]
        with holding(self.session, self.wanted, console, report=True) as held:
            made = engine.bring(held, self.session, before, forced & set(before), device, console, later=later)
            if begun:
                console.say("continuing the training that was begun for this time")
            else:
                left = self._left(began, len(after) + 1)
                chosen = {"guess": guess, "train": self._training(left)}
                write_json(place, chosen)
                console.say(f"{duration(left)} are left for training and the stages after it")
            upto, console.only_new = [*before, "train"], True
            fit = with_settings(self.session, chosen)
            made += engine.bring(held, fit, upto, forced & {"train"}, device, console, later=after)[-1:]
            if made[-1].state == "done" or not set(self._shorter()) <= set(chosen):
                chosen |= self._following(self._left(began, len(after)), made[-1].folder)
                write_json(place, chosen)
                if any(chosen[name] for name in self._shorter()):
                    console.say("that is short: films are shorter, and held-out poses are not fitted")
            session = with_settings(self.session, chosen)
            made += engine.bring(held, session, self.wanted, forced & set(after), device, console)[len(upto) :]
            held.end(session)
        took = time.monotonic() - began
        off = 100 * (took / self.seconds - 1)
        console.say(f"promised {duration(self.seconds)}, took {duration(took)} ({off:+.0f} %)")
        settings = {name: own for name, own in chosen.items() if name != "guess"}
        kept = {"promised": self.seconds, "guess": guess, "took": round(took, 1), "settings": settings}
        return made, kept

    def _left(self, began: float, starts: int) -> float:
        """Seconds left of the time when so many stages have been started."""
        return max(self.seconds - (time.monotonic() - began) - STAGE_START * starts, 0.0)

    def _guess(self, forced: frozenset[str], begun: bool, device: str, console: Console) -> dict[str, float]:
        """Seconds that the least of this run takes: `before` training, `from` then on, and the `share` of processor
        time that training gets now. The whole time is counted down from now on."""
        found, known = self.session.verdicts(self._before(), forced), times.here(device)
        missing = [name for name, verdict in found.items() if not verdict.fresh]
        sizes = times.sizes_of(self.session, missing)._replace(steps=LEAST)
        stage = self.session.pipeline.stages["train"]
        train = known.alone(self.session, stage, sizes).seconds + known.compiling(stage)
        least = 0.0 if begun else train + STAGE_START * (1 + len(self._after()))
        slow = times.slowed("train") if missing or not begun else 1.0
        ahead = known.forecast(self.session, [*missing, "train", *self._after()])
        rest = sum(one.seconds for name, one in ahead.items() if name != "train")
        fitted = ahead["train"]._replace(seconds=max(self.seconds - rest, slow * least), compiling=0.0)
        console.countdown = Countdown((ahead | {"train": fitted}).items())
        before = sum(ahead[name].seconds for name in missing)
        return {"before": round(before, 1), "from": round(slow * least, 1), "share": round(1 / slow, 2)}

    def _say_what_does_not_fit(self, guess: dict[str, float], console: Console) -> None:
        needed = guess["before"] + guess["from"]
        if needed > self.seconds:
            console.say(
                f"{duration(self.seconds)} is too short, by a guess of {duration(guess['before'])} until training "
                f"and {duration(guess['from'])} for the shortest training and what follows; "
                f"the run goes on, about {duration(needed - self.seconds)} late"
            )

    def _begun(self, chosen: dict[str, Any]) -> bool:
        """Whether training with the settings chosen before is finished, or was cut short."""
        if not is_chosen(chosen):
            return False
        session = with_settings(self.session, chosen)
        verdict = session.verdicts(session.pipeline.upstream(["train"]))["train"]
        return verdict.fresh or (
            verdict.recipe is not None and session.workspace.part("train", verdict.recipe.key).is_dir()
        )

    def _training(self, left: float) -> dict[str, float]:
        """The settings of a training with so many seconds left for it and what follows."""
        least = with_settings(self.session, self._shorter())
        reserves = (
            round(self._cost(one.pipeline.stages, ["train", *self._after()]), 1) for one in (self.session, least)
        )
        return dict(zip(("seconds", "reserve", "reserve_least"), (round(max(left, 1.0), 1), *reserves), strict=True))

    def _following(self, left: float, train: Path) -> Chosen:
        """Settings of the stages after a finished training with so many seconds left: their own, or shorter ones where
        those do not fit, going by how long a step took."""
        step = read_json(train / "train.json").get("last_step_seconds", 0.0)
        fits = step * self._cost(self.session.pipeline.stages, self._after()) <= left + SLACK * self.seconds
        return {name: {} for name in self._shorter()} if fits else self._shorter()

    def _shorter(self) -> Chosen:
        """The least settings of the stages after training."""
        stages, found = self.session.pipeline.stages, {}
        for name in self._after():
            if shorter := load_stage(stages[name].module).shorter:
                own = stages[name].params.model_dump()
                found[name] = {setting: min(own[setting], most) for setting, most in shorter.items()}
        return found

    def _cost(self, stages: dict[str, Stage], names: list[str]) -> float:
        """What the stages of these names cost after the last step of training, in training steps."""
        folders = {name: self.session.workspace.links / name for name in self._before()}
        costs = ((stages[name].params, load_stage(stages[name].module).cost) for name in names)
        return sum(cost(params, folders) for params, cost in costs if cost)

    def _before(self) -> list[str]:
        """The stages before training, in running order."""
        return [name for name in self.session.pipeline.upstream(["train"]) if name != "train"]

    def _after(self) -> list[str]:
        """The wanted stages after training, in running order."""
        return [name for name in self.wanted if name != "train" and name not in self._before()]

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

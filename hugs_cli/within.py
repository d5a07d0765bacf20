"""`hugs run VIDEO --within 10m`: as much training as fits into a time, on this machine, and how the promise was kept."""

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
from hugs_cli.studies.comparison import Quiet
from hugs_cli.words import duration

TIME = re.compile(r"(?:(\d+)h)?(?:(\d+)m)?(?:(\d+)s)?")
CHOSEN = "within.json"  # in the pipeline's folder: what train was given, so that a run cut short goes on
START = 2.5  # seconds from a stage to the next one, libraries loaded
SHORT = 300  # seconds; where less is left, films and measuring must not take what training needs
SHORTER = {  # at most, of what is set
    "train": {"curve_points": 4},
    "render": {"turntable_frames": 36, "motion_seconds": 2.0},
    "evaluate": {"fit_steps": 0},
}

# What follows the last step of training, in steps of full size: measured on the kitchen clip, 2 cores, a short training.
FINISH = 40.0  # train: looks at the frames before it writes the person
PICTURE = 0.3  # render: a picture of a film
SCORE, POSE_STEP = 3.0, 0.45  # evaluate: a held-out frame, each time it is measured, and each step that fits its pose


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
    """A run within a time: `session` has results of its own beside the pipeline's, named `default.10m`."""

    session: Session
    wanted: list[str]
    seconds: int

    def keep(self, forced: frozenset[str], device: str, console: Console) -> tuple[list[Ran], dict[str, Any]]:
        """Run what comes before training, give training what is left of the time, and run the rest.

        Returns what ran, and the time promised and taken, in seconds. A run that was cut short goes on with the time
        that its training had left; that of finished training is not looked at again.
        """
        began = time.monotonic()
        before = [name for name in self.session.pipeline.upstream(["train"]) if name != "train"]
        made = engine.run(self.session, before, forced & set(before), device, console)
        place = self.session.workspace.links / CHOSEN
        chosen = read_json(place)
        if "train" in forced or not self._begun(chosen):
            left = self.seconds - (time.monotonic() - began) - START * (len(self.wanted) - len(before))
            chosen = self._chosen(left)
            write_json(place, chosen)
            console.say(f"{duration(chosen['train']['seconds'])} are left for training and what follows")
            if left < SHORT:
                console.say(
                    "that is short: films are shorter, accuracy is measured at fewer moments, no held-out pose is fitted"
                )
        else:
            console.say("goes on with the training that was begun for this time")
        ran = engine.run(timed(self.session, chosen), self.wanted, forced - set(before), device, Quiet())
        ran = [*made, *(one for one in ran if one.stage not in before)]
        took = time.monotonic() - began
        off = 100 * (took / self.seconds - 1)
        console.say(f"promised {duration(self.seconds)}, took {duration(took)} ({off:+.0f} %)")
        return ran, {"promised": self.seconds, "took": round(took, 1), "settings": chosen}

    def _begun(self, chosen: dict[str, Any]) -> bool:
        """Whether training with the settings chosen before is finished, or was cut short."""
        if not whole(chosen):
            return False
        session = timed(self.session, chosen)
        verdict = session.verdicts(session.pipeline.upstream(["train"]))["train"]
        return verdict.fresh or (
            verdict.recipe is not None and session.workspace.part("train", verdict.recipe.key).is_dir()
        )

    def _chosen(self, left: float) -> dict[str, dict[str, Any]]:
        """The settings of stages for a run with so many seconds left."""
        stages, chosen = self.session.pipeline.stages, {"train": {}}
        if left < SHORT:
            for name in [name for name in SHORTER if name in stages]:
                own, limits = stages[name].params.model_dump(), SHORTER[name]
                chosen[name] = {setting: min(own[setting], most) for setting, most in limits.items() if setting in own}
        short = timed(self.session, chosen).pipeline.stages
        chosen["train"] |= {"seconds": round(max(left, 1.0), 1), "reserve": round(self._reserve(short), 1)}
        return chosen

    def _reserve(self, stages: dict[str, Stage]) -> float:
        """What follows the last step of training, in steps."""
        steps = FINISH
        if "render" in self.wanted:
            films, (frames, heldout) = stages["render"].params, self._frames()
            steps += PICTURE * (films.turntable_frames + films.motion_seconds * films.fps + heldout + frames)
        if "evaluate" in self.wanted:
            fitted = stages["evaluate"].params.fit_steps
            steps += self._frames()[1] * (SCORE * (1 + bool(fitted)) + POSE_STEP * fitted)
        return steps

    def _frames(self) -> tuple[int, int]:
        """How many frames have a camera, and how many of them are held out."""
        from stages.formats.cameras import read_cameras
        from stages.formats.splits import read_split

        sfm = self.session.workspace.links / "sfm"
        names = read_cameras(sfm / "cameras.npz").names
        return len(names), int(read_split(sfm / "split.json", names).heldout.sum())


def promise(session: Session, stages: list[str] | None, text: str) -> Promise:
    """The promise to bring `stages` (all if None) of a pipeline up to date within a time, as in '10m'."""
    seconds = seconds_of(text)
    wanted = session.pipeline.upstream(stages or session.pipeline.stages)
    if "train" not in wanted or "seconds" not in type(session.pipeline.stages["train"].params).model_fields:
        raise UsageError("--within is for runs that train", "leave it out, or name train or a stage after it")
    if not getattr(session.pipeline.stages["train"].params, "joint", True):
        raise UsageError("--within is for trainings of person and scene together", "leave out train.joint, or --within")
    return Promise(named(session, text.strip()), wanted, seconds)


def named(session: Session, text: str) -> Session:
    """The session of a pipeline's results within a time."""
    name = f"{session.pipeline.name}.{text}"
    place = Workspace(session.video, session.workspace.work, name)
    return replace(session, workspace=place, pipeline=replace(session.pipeline, name=name))


def timed(session: Session, chosen: dict[str, dict[str, Any]]) -> Session:
    """The session with the settings that were chosen, by stage."""
    own = session.pipeline.stages
    given = {n: replace(own[n], params=own[n].params.model_copy(update=s)) for n, s in chosen.items() if n in own}
    return replace(session, pipeline=replace(session.pipeline, stages={**own, **given}))


def whole(chosen: dict[str, Any]) -> bool:
    """Whether a memory of what was chosen is one."""
    train = chosen.get("train")
    return (
        isinstance(train, dict)
        and {"seconds", "reserve"} <= set(train)
        and all(isinstance(s, dict) for s in chosen.values())
    )


def remembered(session: Session, text: str) -> Session:
    """The session of `--pipeline default.10m`: what `--within 10m` was given; UsageError if there was no such run."""
    session = named(session, text)
    chosen = read_json(session.workspace.links / CHOSEN)
    if not whole(chosen):
        base = session.pipeline.name.rpartition(".")[0]
        raise UsageError(
            f"no run of pipeline {base} within {text}", f"`hugs run VIDEO --pipeline {base} --within {text}`"
        )
    return timed(session, chosen)


def is_time(text: str) -> bool:
    """Whether `text` is a time, as in '10m'."""
    return bool(text and TIME.fullmatch(text))

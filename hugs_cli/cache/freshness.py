"""Is a stage's result fresh? What would make a new one, what the last one was made of, and the reasons for a re-run."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hugs_cli.cache.fingerprint import Code, digest
from hugs_cli.cache.workspace import Stamp, Workspace, decisions
from hugs_cli.pipelines import SOURCES, Pipeline, Stage, UsageError


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a result; equal recipes have equal keys. Device and library versions are not in it."""

    stage: str
    seed: int
    code: dict[str, str]
    params: dict[str, Any]
    inputs: dict[str, str | None]

    @property
    def key(self) -> str:
        """sha256 of it all."""
        return digest([self.stage, self.seed, self.code, self.params, self.inputs])


@dataclass(frozen=True)
class FirstRun:
    """This pipeline has no result of the stage yet."""

    def __str__(self) -> str:
        return "first run"


@dataclass(frozen=True)
class CodeChanged:
    """A module (or a data file of the code) is not what it was."""

    module: str
    how: str  # edited, new, gone

    def __str__(self) -> str:
        return f"code {self.module} {self.how}"


@dataclass(frozen=True)
class ParamChanged:
    """A setting that counts has another value."""

    name: str
    old: Any
    new: Any

    def __str__(self) -> str:
        return f"params.{self.name}: {self.old} -> {self.new}"


@dataclass(frozen=True)
class InputChanged:
    """An input's content is not what it was."""

    name: str
    how: str = "changed"  # changed, new, gone
    decided: tuple[str, ...] = ()
    """What the stage it comes from decides otherwise now: "shadow off -> on"."""

    def __str__(self) -> str:
        return f"inputs.{self.name} {self.how}" + (f" ({', '.join(self.decided)})" if self.decided else "")


@dataclass(frozen=True)
class SeedChanged:
    """The run has another seed."""

    old: int
    new: int

    def __str__(self) -> str:
        return f"seed: {self.old} -> {self.new}"


@dataclass(frozen=True)
class Damaged:
    """The result is there, but not as it was written."""

    what: str

    def __str__(self) -> str:
        return f"result damaged: {self.what}"


@dataclass(frozen=True)
class Forced:
    """Asked for with --force."""

    def __str__(self) -> str:
        return "forced"


@dataclass(frozen=True)
class Unfinished:
    """An earlier run of the same key was cut short."""

    continues: bool

    def __str__(self) -> str:
        return "continues a run cut short" if self.continues else "last run was cut short"


@dataclass(frozen=True)
class Upstream:
    """Stages it needs would run first; whether their result changes is not known before."""

    stages: tuple[str, ...]

    def __str__(self) -> str:
        return f"after {', '.join(self.stages)}"


Reason = FirstRun | CodeChanged | ParamChanged | InputChanged | SeedChanged | Damaged | Forced | Unfinished | Upstream


@dataclass(frozen=True)
class Verdict:
    """What was found about one stage: `stamp` and `folder` of a fresh result, or why it would run."""

    stage: str
    reasons: tuple[Reason, ...] = ()
    recipe: Recipe | None = None
    """None while inputs are not known, because stages before it would run."""
    folder: Path | None = None
    stamp: Stamp | None = None
    last: Stamp | None = None
    """What this pipeline's link shows now."""

    @property
    def fresh(self) -> bool:
        """True if there is nothing to do."""
        return self.stamp is not None

    @property
    def state(self) -> str:
        """fresh; stale, missing (would run); waits (may run, after others)."""
        if self.fresh:
            return "fresh"
        if all(isinstance(reason, Upstream) for reason in self.reasons):
            return "waits"
        return "missing" if self.last is None else "stale"


@dataclass
class Judge:
    """Asks of one clip and one pipeline what is fresh."""

    workspace: Workspace
    pipeline: Pipeline
    sources: dict[str, Path | None]
    seed: int = 0
    code: Code = field(default_factory=Code)
    seeds: dict[str, int] = field(default_factory=dict)
    """Of stages that do not take `seed`."""

    def all(self, wanted: list[str], forced: frozenset[str] = frozenset()) -> dict[str, Verdict]:
        """A verdict for each wanted stage, in order, nothing run."""
        self.check_sources()
        found: dict[str, Verdict] = {}
        for name in wanted:
            found[name] = self.one(self.pipeline.stages[name], found, name in forced)
        self.code.save()
        return found

    def one(self, stage: Stage, before: dict[str, Verdict], forced: bool = False) -> Verdict:
        """The verdict on one stage, given those on the stages it needs."""
        linked = self.workspace.linked(stage.name)
        last = Stamp.read(linked) if linked else None
        seed = self.seeds.get(stage.name, self.seed)
        code, params = self.code.digests(stage.module), stage.settings()
        stale = tuple(need for need in stage.needs if need in before and not before[need].fresh)
        if stale:
            own = changes(last, Recipe(stage.name, seed, code, params, last.inputs)) if last else (FirstRun(),)
            own = (Forced(),) if forced else own
            return Verdict(stage.name, (*own, Upstream(stale)), last=last)
        inputs = {need: self.input(need, before) for need in sorted(stage.needs)}
        recipe = Recipe(stage.name, seed, code, params, inputs)
        folder, part = self.workspace.folder(stage.name, recipe.key), self.workspace.part(stage.name, recipe.key)
        stamp = Stamp.read(folder)
        whole = stamp is not None and stamp.key == recipe.key
        damage = stamp.damage(folder) if whole else ""
        if whole and not damage and not forced:
            return Verdict(stage.name, (), recipe, folder, stamp, last)
        reasons: tuple[Reason, ...] = (Forced(),) if forced else (Damaged(damage),) if damage else ()
        if not reasons:
            cut = (Unfinished(stage.resumes),) if part.is_dir() else ()
            differing = (self.told(reason, last, before) for reason in changes(last, recipe)) if last else (FirstRun(),)
            reasons = (*differing, *cut)
        if not reasons:
            reasons = (Damaged("it is gone or has no stamp"),)
        return Verdict(stage.name, reasons, recipe, folder, None, last)

    def input(self, need: str, before: dict[str, Verdict]) -> str | None:
        """The content digest of what a stage needs: an earlier stage's result or a source."""
        if need in self.pipeline.stages:
            return before[need].stamp.content
        return self.workspace.source(need, self.sources.get(need))

    def told(self, reason: Reason, last: Stamp, before: dict[str, Verdict]) -> Reason:
        """A reason of the result that `last` stamps; of a changed input also what its stage decides otherwise now."""
        if not isinstance(reason, InputChanged) or reason.name not in self.pipeline.stages:
            return reason
        old = self.workspace.holding(reason.name, last.inputs.get(reason.name))
        folders = (old, before[reason.name].folder)
        was, now = (decisions(folder, reason.name) if folder else {} for folder in folders)
        words = {True: "on", False: "off"}
        decided = (
            f"{name} {words[was[name]]} -> {words[now[name]]}" for name in now if was.get(name, now[name]) != now[name]
        )
        return replace(reason, decided=tuple(decided))

    def changed(self, need: str, content: str | None) -> bool:
        """True if a source has not, or no longer, the content that a run began with."""
        return need in SOURCES and self.workspace.source(need, self.sources.get(need)) != content

    def check_sources(self) -> None:
        """Refuse sources that are given but not there, or that no stage of this pipeline takes."""
        taken = {need for stage in self.pipeline.stages.values() for need in stage.needs}
        for name, path in self.sources.items():
            if path is not None and not path.exists():
                what = "video" if name == "video" else f"file for {SOURCES[name]}"
                raise UsageError(f"no {what} at {path}", "check the path")
            if path is not None and name not in taken:
                hint = "leave it out, or choose another pipeline"
                raise UsageError(f"no stage of pipeline {self.pipeline.name} reads {SOURCES[name]}", hint)

    def path(self, need: str, before: dict[str, Verdict]) -> Path | None:
        """Where that lies."""
        return before[need].folder if need in self.pipeline.stages else self.sources.get(need)


def changes(last: Stamp, recipe: Recipe) -> tuple[Reason, ...]:
    """What differs between the last result's recipe and a new one: settings, seed, inputs, code."""
    found: list[Reason] = []
    for name in sorted({*last.params, *recipe.params}):
        old, new = last.params.get(name, "(not there)"), recipe.params.get(name, "(gone)")
        if old != new:
            found.append(ParamChanged(name, old, new))
    if last.seed != recipe.seed:
        found.append(SeedChanged(last.seed, recipe.seed))
    for name in sorted({*last.inputs, *recipe.inputs}):
        old, new = last.inputs.get(name), recipe.inputs.get(name)
        if old != new:
            found.append(InputChanged(name, "new" if old is None else "gone" if new is None else "changed"))
    for name in sorted({*last.code, *recipe.code}):
        old, new = last.code.get(name), recipe.code.get(name)
        if old != new:
            found.append(CodeChanged(name, "new" if old is None else "gone" if new is None else "edited"))
    return tuple(found)

"""Is a stage's result fresh? Compares the recipe of a new result with that of the last one, and names the differences."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hugs_cli.cache.fingerprint import Code, digest
from hugs_cli.cache.workspace import Stamp, Workspace, decisions
from hugs_cli.pipelines import SOURCES, Pipeline, Stage, UsageError


@dataclass(frozen=True)
class Recipe:
    """All that decides a result: equal recipes have equal keys. Device and library versions are left out."""

    stage: str
    seed: int
    code: dict[str, str]
    params: dict[str, Any]
    inputs: dict[str, str | None]

    @property
    def key(self) -> str:
        """sha256 of all fields."""
        return digest([self.stage, self.seed, self.code, self.params, self.inputs])


@dataclass(frozen=True)
class FirstRun:
    """This pipeline has no result of the stage yet."""

    def __str__(self) -> str:
        return "first run"


@dataclass(frozen=True)
class CodeChanged:
    """A module, or a data file beside it, has changed."""

    module: str
    how: str  # edited, new, gone

    def __str__(self) -> str:
        return f"code {self.module} {self.how}"


@dataclass(frozen=True)
class ParamChanged:
    """A setting has another value."""

    name: str
    old: Any
    new: Any

    def __str__(self) -> str:
        return f"params.{self.name}: {self.old} -> {self.new}"


ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+:)/+(.*)", re.IGNORECASE)  # as a path, which has one / for two
UNREAD = "no longer read"


@dataclass(frozen=True)
class InputChanged:
    """The content of an input has changed."""

    name: str
    how: str = "changed"  # changed, new, gone, or UNREAD
    decided: tuple[str, ...] = ()
    """Decisions of its stage that differ now: "shadow off -> on"."""

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
    """The result's files have changed since they were written."""

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
    """Stages before it must run first; their results may or may not change."""

    stages: tuple[str, ...]

    def __str__(self) -> str:
        return f"after {', '.join(self.stages)}"


Reason = FirstRun | CodeChanged | ParamChanged | InputChanged | SeedChanged | Damaged | Forced | Unfinished | Upstream


@dataclass(frozen=True)
class Verdict:
    """Is one stage fresh? `stamp` and `folder` of its result, or the reasons to run it."""

    stage: str
    reasons: tuple[Reason, ...] = ()
    recipe: Recipe | None = None
    """None while inputs are not known, because stages before it would run."""
    folder: Path | None = None
    stamp: Stamp | None = None
    last: Stamp | None = None
    """The stamp of the result that the pipeline links to now."""

    @property
    def fresh(self) -> bool:
        """True if there is nothing to do."""
        return self.stamp is not None

    @property
    def only_code(self) -> bool:
        """Whether a result is there of which nothing but code has changed: a stage that no longer reads an input is that, too."""
        others = (one for one in self.reasons if not isinstance(one, CodeChanged | Unfinished))
        only = all(isinstance(one, InputChanged) and one.how == UNREAD for one in others)
        return only and self.last is not None and not self.fresh

    @property
    def made(self) -> Stamp:
        """The stamp of a fresh result; an error where it is not fresh."""
        assert self.stamp is not None, f"{self.stage} is not fresh"
        return self.stamp

    @property
    def state(self) -> str:
        """fresh; stale, missing (would run); waits (may run, after others)."""
        if self.fresh:
            return "fresh"
        if all(isinstance(reason, Upstream) for reason in self.reasons):
            return "waits"
        return "missing" if self.last is None else "stale"


@dataclass
class Session:
    """One clip and one pipeline, as a command was given them; says which results are fresh."""

    workspace: Workspace
    pipeline: Pipeline
    sources: dict[str, Path | None]
    seed: int = 0
    code: Code = field(default_factory=Code)
    seeds: dict[str, int] = field(default_factory=dict)
    """Seeds of single stages; all others take `seed`."""
    options: dict[str, Any] = field(default_factory=dict)
    """Those that the session was opened with, for `options.json`; empty where nobody gave any."""

    @property
    def video(self) -> Path:
        """The clip, which every session has."""
        video = self.sources["video"]
        assert video is not None
        return video

    def verdicts(self, wanted: list[str], forced: frozenset[str] = frozenset()) -> dict[str, Verdict]:
        """A verdict on each wanted stage, in order. Runs nothing."""
        self.check_sources()
        found: dict[str, Verdict] = {}
        for name in wanted:
            found[name] = self.verdict(self.pipeline.stages[name], found, name in forced)
        self.code.save()
        return found

    def verdict(self, stage: Stage, before: dict[str, Verdict], forced: bool = False) -> Verdict:
        """The verdict on one stage, given the verdicts on its inputs."""
        linked = self.workspace.linked(stage.name)
        last = Stamp.read(linked) if linked else None
        seed = self.seeds.get(stage.name, self.seed)
        code, params = self.code.digests(stage.module), stage.settings()
        stale = tuple(need for need in stage.needs if need in before and not before[need].fresh)
        if stale:
            own = changes(last, Recipe(stage.name, seed, code, params, last.inputs)) if last else (FirstRun(),)
            own = (Forced(),) if forced else own
            return Verdict(stage.name, (*own, Upstream(stale)), last=last)
        inputs = {need: self.input_digest(need, before) for need in sorted(stage.needs)}
        recipe = Recipe(stage.name, seed, code, params, inputs)
        folder, part = self.workspace.folder(stage.name, recipe.key), self.workspace.part(stage.name, recipe.key)
        if linked and last and last.key == recipe.key and not folder.exists():
            folder = linked  # it was accepted, and that was killed before it had its new name
        stamp = Stamp.read(folder)
        if stamp and stamp.key != recipe.key:
            stamp = None
        damage = stamp.damage(folder) if stamp else ""
        if stamp and not damage and not forced:
            return Verdict(stage.name, (), recipe, folder, stamp, last)
        reasons: tuple[Reason, ...] = (Forced(),) if forced else (Damaged(damage),) if damage else ()
        if not reasons:
            cut = (Unfinished(stage.resumes),) if part.is_dir() else ()
            own = changes(last, recipe) if last else (FirstRun(),)
            reasons = (*(self.with_decisions(reason, last, before) for reason in own), *cut)
        if not reasons:
            reasons = (Damaged("it is gone or has no stamp"),)
        return Verdict(stage.name, reasons, recipe, folder, None, last)

    def acceptable(
        self, wanted: list[str], keep: Callable[[Verdict], Stamp | None] = lambda verdict: verdict.last
    ) -> dict[str, tuple[Verdict, Stamp | None]]:
        """A verdict on each wanted stage, as if the results before it were kept whose code alone has changed; and of those the
        stamp that `keep` gives, None of others."""
        found: dict[str, Verdict] = {}
        kept: dict[str, tuple[Verdict, Stamp | None]] = {}
        for name in self.pipeline.upstream(wanted):
            verdict = found[name] = self.verdict(self.pipeline.stages[name], found)
            if name in wanted:
                stamp = keep(verdict) if verdict.only_code else None
                found[name] = replace(verdict, stamp=stamp) if stamp else verdict
                kept[name] = verdict, stamp
        return kept

    def input_digest(self, need: str, before: dict[str, Verdict]) -> str | None:
        """The digest of an input's content: an earlier stage's result or a source."""
        if need in self.pipeline.stages:
            return before[need].made.content
        return self.workspace.source(need, self.sources.get(need))

    def with_decisions(self, reason: Reason, last: Stamp | None, before: dict[str, Verdict]) -> Reason:
        """The reason; a changed input also gets the decisions its stage now takes differently."""
        if last is None or not isinstance(reason, InputChanged) or reason.name not in before:
            return reason
        old = next(self.workspace.with_content(reason.name, last.inputs.get(reason.name)), None)
        folders = (old and old[0], before[reason.name].folder)
        was, now = (decisions(folder, reason.name) if folder else {} for folder in folders)
        words = {True: "on", False: "off"}
        decided = (
            f"{name} {words[was[name]]} -> {words[now[name]]}" for name in now if was.get(name, now[name]) != now[name]
        )
        return replace(reason, decided=tuple(decided))

    def source_changed(self, need: str, content: str | None) -> bool:
        """Whether a source has other content than when the run began."""
        return need in SOURCES and self.workspace.source(need, self.sources.get(need)) != content

    def check_sources(self) -> None:
        """UsageError for a source that does not exist, or that no stage of this pipeline reads."""
        taken = {need for stage in self.pipeline.stages.values() for need in stage.needs}
        for name, path in self.sources.items():
            if path is not None and not path.exists():
                what = "video" if name == "video" else f"file for {SOURCES[name]}"
                if address := ADDRESS.fullmatch(str(path)):
                    hint = "download it first, and give the path of the file"
                    raise UsageError(f"{address[1]}//{address[2]} is an address, not a {what}", hint)
                raise UsageError(f"no {what} at {path}", "check the path")
            if path is not None and name not in taken:
                hint = "leave it out, or choose another pipeline"
                raise UsageError(f"no stage of pipeline {self.pipeline.name} reads {SOURCES[name]}", hint)
            if path is not None and path.is_dir() and lies_in(self.workspace.root, path):
                hint = f"choose a folder elsewhere, as `--work {path.resolve().parent / 'work'}`"
                raise UsageError(f"results would be written into {path}, which is a source", hint)

    def input_path(self, need: str, before: Mapping[str, Verdict]) -> Path | None:
        """Where an input lies: an earlier stage's folder or a source."""
        return before[need].folder if need in self.pipeline.stages else self.sources.get(need)


def lies_in(folder: Path, source: Path) -> bool:
    """Whether files of a folder, there already or not, would be among those of a source; hidden ones never are."""
    own, place = Path(os.path.realpath(folder)), Path(os.path.realpath(source))
    return own.is_relative_to(place) and not any(part[0] == "." for part in own.relative_to(place).parts)


def changes(last: Stamp, recipe: Recipe) -> tuple[Reason, ...]:
    """Differences between the last result's recipe and a new one: settings, seed, inputs, code."""
    found: list[Reason] = []
    for name in sorted({*last.params, *recipe.params}):
        old, new = last.params.get(name, "(not there)"), recipe.params.get(name, "(gone)")
        if old != new:
            found.append(ParamChanged(name, old, new))
    if last.seed != recipe.seed:
        found.append(SeedChanged(last.seed, recipe.seed))
    for name in sorted({*last.inputs, *recipe.inputs}):
        old, new = last.inputs.get(name), recipe.inputs.get(name)
        how = "new" if old is None else UNREAD if name not in recipe.inputs else "gone" if new is None else "changed"
        if old != new:
            found.append(InputChanged(name, how))
    for name in sorted({*last.code, *recipe.code}):
        old, new = last.code.get(name), recipe.code.get(name)
        if old != new:
            found.append(CodeChanged(name, "new" if old is None else "gone" if new is None else "edited"))
    return tuple(found)

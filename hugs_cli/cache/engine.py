"""Runs the stages that are not fresh, each in a process of its own, and publishes the results."""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from functools import partial
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hugs_cli import times
from hugs_cli.cache import child, whole
from hugs_cli.cache.checks import check
from hugs_cli.cache.fingerprint import files_under
from hugs_cli.cache.freshness import Forced, ParamChanged, Reason, Recipe, Session, Verdict, changes
from hugs_cli.cache.held import Held, holding
from hugs_cli.cache.launcher import Outcome
from hugs_cli.cache.workspace import (
    LOG,
    OURS,
    STAMP,
    FileFacts,
    Machine,
    Stamp,
    remove,
    seal,
)
from hugs_cli.console import Console, reasons_text
from hugs_cli.device import device_of
from hugs_cli.direct import StageFailed, failed
from hugs_cli.pipelines import Stage
from stages.contract import StageRecord

FULL_DISK = 1 << 20  # bytes
EARLIER = ".earlier.json"  # beside an unfinished result: what it has taken so far


@dataclass(frozen=True)
class Ran:
    """One stage of a finished run; `state` is cached or done."""

    stage: str
    state: str
    reasons: tuple[Reason, ...]
    folder: Path
    stamp: Stamp


class RunStopped(BaseException):
    """The run was asked to stop and did: exit code 130."""

    def __init__(self, stage: str = "", continues: bool = False):
        super().__init__(stage)
        self.stage, self.continues = stage, continues


def run(
    session: Session,
    wanted: list[str],
    forced: frozenset[str],
    device: str,
    console: Console,
    taken: Mapping[str, Verdict] = MappingProxyType({}),
    report: bool = False,
    later: Sequence[str] = (),
) -> list[Ran]:
    """`bring` the wanted stages up to date; a page of them grows meanwhile if it is to `report`."""
    with holding(session, wanted, console, report) as held:
        ran = bring(held, session, wanted, forced, device, console, taken, later)
        held.end(session)
    return ran


def bring(
    held: Held,
    session: Session,
    wanted: list[str],
    forced: frozenset[str],
    device: str,
    console: Console,
    taken: Mapping[str, Verdict] = MappingProxyType({}),
    later: Sequence[str] = (),
) -> list[Ran]:
    """Bring the wanted stages (given in running order) up to date; raises StageFailed or RunStopped at the first
    stage that does not finish. What was finished before stays. Results of other stages are `taken` as they are. Before the first
    that is made, all check what they are given, and those that are brought up to date `later`, too."""
    done = dict(taken)
    ran: list[Ran] = []
    unchecked = [session.pipeline.stages[name] for name in (*wanted, *later)]
    stages = [session.pipeline.stages[name] for name in wanted]
    for stage, after in zip_longest(stages, stages[1:]):
        name = stage.name
        verdict = session.verdict(stage, done, name in forced)
        assert verdict.folder, "every stage before it is fresh by now"
        if stamp := verdict.stamp or rescued(session, verdict):
            console.begin(sure=False)
            console.cached(name, stamp)
            state = "cached"
            other = changes(verdict.last, verdict.recipe) if verdict.last and verdict.recipe else ()
            if back := tuple(reason for reason in other if isinstance(reason, ParamChanged)):
                console.below(f"linked again: {reasons_text(back)}")
        else:
            if unchecked:
                check(session, unchecked[unchecked.index(stage) :], held.launcher)
                unchecked = []
            console.begin(sure=True)
            if console.countdown is None:
                known = times.here(device_of(device)[0])
                ahead = times.expected(session, stages[len(ran) :], done, forced, known)
                console.expect(ahead, partial(known.again, session))
            then = after.loads if after else None
            stamp, state = make(session, stage, verdict, done, device, held, then, console), "done"
        session.workspace.link(name, verdict.folder)
        done[name] = replace(verdict, stamp=stamp)
        ran.append(Ran(name, state, verdict.reasons, verdict.folder, stamp))
        if held.page:
            held.page.has(name, done[name])
    session.code.save()
    return ran


def rescued(session: Session, verdict: Verdict) -> Stamp | None:
    """The result of a run that was killed when it was whole and had not got its name; None if there is none, or by force."""
    recipe, part = known(session, verdict)
    stamp = None if Forced() in verdict.reasons or part.is_symlink() else Stamp.read(part)
    if stamp is None or stamp.key != recipe.key or stamp.damage(part) or {*files_under(part)} - {*OURS, *stamp.files}:
        return None
    session.workspace.publish(part, session.workspace.folder(verdict.stage, recipe.key))
    return stamp


def known(session: Session, verdict: Verdict) -> tuple[Recipe, Path]:
    """The recipe of a stage whose inputs are all there, and the folder of its unfinished result."""
    assert verdict.recipe, "every stage before it is fresh by now"
    return verdict.recipe, session.workspace.part(verdict.stage, verdict.recipe.key)


def make(
    session: Session,
    stage: Stage,
    verdict: Verdict,
    done: Mapping[str, Verdict],
    device: str,
    held: Held,
    then: Sequence[str] | None,
    console: Console,
) -> Stamp:
    """Run one stage into its .part folder, stamp the result and give the folder its final name.

    `then` names the libraries that the next stage loads, None if this is the last.
    """
    page, (recipe, part) = held.page, known(session, verdict)
    resumes = (
        stage.resumes
        and Forced() not in verdict.reasons
        and not any(one.is_symlink() for one in (part, *part.rglob("*")))
    )
    if os.path.lexists(part) and not resumes:  # runs leave no links, by which they would write elsewhere
        remove(part)
    part.mkdir(exist_ok=True)
    (part / STAMP).unlink(missing_ok=True)
    device, _ = device_of(device)
    inputs = {need: session.input_path(need, done) for need in stage.needs}
    job = {
        "module": stage.module,
        "params": stage.params.model_dump(mode="json"),
        "inputs": {need: str(path.absolute()) if path else None for need, path in inputs.items()},
        "out": str(part.absolute()),
        "device": device,
        "seed": recipe.seed,
        "resumes": stage.resumes,
        "upstream": upstream_records(session, stage, done),
    }
    console.started(stage.name, verdict.reasons)
    if page:
        page.begins(stage.name, part)

    def heard(event: dict[str, Any]) -> None:
        console.heard(stage.name, event)
        if page:
            page.heard(event, console.time_left(stage.name))

    outcome = held.launcher.launch(job, part / LOG, heard, then)
    with uninterrupted():  # a result that is there is kept, whatever comes now
        if stage.resumes:
            add_earlier(part / EARLIER, outcome)
        stamp = publish(session, stage, verdict, outcome, device, console)
    if outcome.asked:
        raise RunStopped
    return stamp


def add_earlier(file: Path, outcome: Outcome) -> None:
    """Add to the outcome what earlier runs of the stage, which did not end, have taken and said; keep it if this one did not."""
    if file.exists():
        earlier = json.loads(file.read_text())
        outcome.seconds += earlier["seconds"]
        outcome.compiling += earlier.get("compiling", 0.0)
        outcome.peak_memory_bytes = max(outcome.peak_memory_bytes, earlier["peak_memory_bytes"])
        outcome.notes = list(dict.fromkeys([*earlier["notes"], *outcome.notes]))
        outcome.warnings = list(dict.fromkeys([*earlier["warnings"], *outcome.warnings]))
    if outcome.kind == "done":
        file.unlink(missing_ok=True)
        return
    kept = ("seconds", "compiling", "peak_memory_bytes", "notes", "warnings")
    with suppress(OSError):  # a full disk: then the next run tells its own time alone
        whole.replace(file, json.dumps({key: getattr(outcome, key) for key in kept}))


def publish(session: Session, stage: Stage, verdict: Verdict, outcome: Outcome, device: str, console: Console) -> Stamp:
    """Stamp what a stage has left in its .part folder and give the folder its final name; raises what `make` does."""
    workspace, (recipe, part) = session.workspace, known(session, verdict)
    folder = workspace.folder(stage.name, recipe.key)
    facts = {
        "when": now(),
        "stage": stage.name,
        "pipeline": session.pipeline.name,
        "key": recipe.key,
        "reasons": [str(reason) for reason in verdict.reasons],
        "seconds": round(outcome.seconds, 3),
        "peak_memory_bytes": outcome.peak_memory_bytes,
        "host": platform.node(),
        "device": device,
    }
    if outcome.kind == "done":
        content, files = seal(part)
        if not files:
            outcome = replace(outcome, kind="crash", facts={"problem": "it ended without an error but wrote no file"})
        elif doubt := distrust(session, stage, recipe, part):
            outcome = replace(outcome, kind="error", facts=doubt)
    if outcome.kind != "done":
        console.ended(stage.name, outcome)
        error = failure(stage, outcome, part / LOG, continues=stage.resumes and not folder.exists())
        problem = {"problem": error.problem} if isinstance(error, StageFailed) else {}
        workspace.log_run(**facts, result=outcome.kind, **problem)
        raise error
    stamp = stamp_of(recipe, content, files, outcome, facts)
    stamp.write(part)
    workspace.publish(part, folder)
    workspace.link(stage.name, folder)
    workspace.log_run(**facts, result="done")
    times.learn(session, stage, stamp.seconds, device, outcome.compiling)
    console.ended(stage.name, outcome)  # said last: who cannot hear it any more loses nothing
    return stamp


def upstream_records(session: Session, stage: Stage, done: Mapping[str, Verdict]) -> dict[str, Any]:
    """The fields of a `contract.StageRecord` of every stage before this one, in running order."""
    before = [name for name in session.pipeline.upstream([stage.name]) if name != stage.name]
    stamps = {name: done[name].made for name in before}
    return {name: {f.name: getattr(stamp, f.name) for f in fields(StageRecord)} for name, stamp in stamps.items()}


def distrust(session: Session, stage: Stage, recipe: Recipe, part: Path) -> dict[str, Any] | None:
    """Why the result of a stage that ended well cannot be trusted, as an error's problem, hint and facts; None if it can."""
    free = shutil.disk_usage(part).free
    if free < FULL_DISK:  # libraries in C cut files short there without a word
        hint = "free some space; `hugs gc` removes results that nothing uses"
        return {"problem": f"the disk is full at {part}", "hint": hint, "facts": [f"{free} bytes are free"]}
    for need in stage.needs:
        if session.source_changed(need, recipe.inputs[need]):
            hint = "run again when nothing writes to it; finished stages are kept"
            return {"problem": f"{session.sources[need]} changed while {stage.name} ran", "hint": hint, "facts": []}
    return None


def stamp_of(
    recipe: Recipe, content: str, files: dict[str, FileFacts], outcome: Outcome, facts: dict[str, Any]
) -> Stamp:
    """The stamp of a finished run."""
    machine: Machine = {
        "host": facts["host"],
        "device": facts["device"],
        "system": f"{platform.system()} {platform.machine()}",
        "processors": child.processors(),
        "versions": outcome.facts["versions"],
    }
    if (gpu := outcome.facts.get("peak_gpu_memory_bytes")) is not None:
        machine["peak_gpu_memory_bytes"] = gpu
    return Stamp(
        **vars(recipe),
        key=recipe.key,
        content=content,
        files=files,
        made=facts["when"],
        seconds=facts["seconds"],
        peak_memory_bytes=outcome.peak_memory_bytes,
        machine=machine,
        reasons=facts["reasons"],
        notes=outcome.notes,
        warnings=outcome.warnings,
    )


def failure(stage: Stage, outcome: Outcome, log: Path, continues: bool) -> BaseException:
    """The error that says how a stage ended without a result; `continues`: the next run goes on where it was stopped."""
    facts = outcome.facts
    if outcome.kind == "stopped":
        return RunStopped(stage.name, continues)
    if outcome.kind in ("error", "crash"):
        return failed({**facts, "event": outcome.kind}, f"stage {stage.name}", str(log))
    memory = f"peak memory {outcome.peak_memory_bytes / 2**30:.1f} GiB after {outcome.seconds:.0f} s"
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()][-3:]
    if not facts["signal"] > 0:
        return StageFailed(f"stage {stage.name} ended with exit code {facts['exit']}", f"see {log}", [memory, *lines])
    name = signal.Signals(facts["signal"]).name
    hint = f"see {log}"
    if name == "SIGKILL":
        hint = "most often the system ran out of memory: close other programs, or use `--pipeline preview`"
    return StageFailed(f"stage {stage.name} was killed by {name}", hint, [memory, *lines])


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the block is done."""
    held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)


def now() -> str:
    """The time, to the second, with its zone."""
    return datetime.now(UTC).isoformat(timespec="seconds")

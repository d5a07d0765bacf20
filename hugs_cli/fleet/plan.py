"""What a fleet has to do: which rows are fresh, which stages are left, how long and how much memory they will take.

All in this process: the cache's own verdicts, with the code and each pipeline read once for all clips.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from hugs_cli import options, pipelines, times
from hugs_cli.cache.fingerprint import Code
from hugs_cli.cache.freshness import Session
from hugs_cli.cache.workspace import Stamp, Workspace, decisions, read_json
from hugs_cli.fleet import keep
from hugs_cli.fleet.clips import Row
from hugs_cli.fleet.history import History
from hugs_cli.within import is_time
from stages.contract import StageError

BEFORE, AFTER, WHOLE = "before", "train", "clip"
"""Steps of a clip: the stages before training, those from training on; or all."""
PAGES = ("report.html", "export/viewer.html")
"""In a pipeline's folder: what a fleet's page links to."""


@dataclass
class Planned:
    """One row of the plan: fresh, todo, or failed where it cannot even begin."""

    row: Row
    state: str
    stages: list[str] = field(default_factory=list)
    """All of its pipeline."""
    todo: list[str] = field(default_factory=list)
    expected: dict[str, float] = field(default_factory=dict)
    """Stage to do -> seconds that it will about take."""
    megabytes: int = 0
    result: dict[str, Any] = field(default_factory=dict)
    """Of a fresh row, see `result_of`."""
    problem: str = ""
    hint: str = ""
    facts: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """That the stages to do will about take."""
        return sum(self.expected.values())

    def slowed(self, times: float) -> None:
        """Expect it to take so many times as long."""
        self.expected = {name: times * seconds for name, seconds in self.expected.items()}


@dataclass(frozen=True)
class Common:
    """What all rows of a fleet share."""

    work: Path
    pipelines_file: Path = pipelines.FILE
    body_model: Path | None = None
    device: str = "auto"
    keep: tuple[str, ...] = ()
    """Stages whose results stay of a finished clip; none: all do."""


def session_of(row: Row, common: Common) -> Session:
    """The session of one row, as `hugs run` opens it."""
    given = options.RunOptions(
        list(row.settings),
        row.masks,
        row.person,
        smpl_fit=row.fit,
        body_model=common.body_model,
        pipeline=row.pipeline,
        work=row.work,
        pipelines_file=common.pipelines_file,
    )
    return given.session(row.video)


def opener(common: Common) -> Callable[[Row], Session]:
    """`session_of` for many rows: reads each pipeline, and the code, once."""
    code = Code(common.work / options.CODE_MEMORY, frozen=True)
    known: dict[tuple[Any, ...], Session] = {}

    def open_(row: Row) -> Session:
        if is_time(row.pipeline.rpartition(".")[2]):  # each clip has chosen its own settings for `--within`
            return replace(session_of(row, common), code=code)
        same = (row.pipeline, row.settings, row.person)
        if same not in known:
            known[same] = replace(session_of(row, common), code=code)
        sources = known[same].sources | {"video": row.video, "mask_files": row.masks, "smpl_fit": row.fit}
        return replace(known[same], sources=sources, workspace=Workspace(row.video, row.work, row.pipeline))

    return open_


def plan(rows: list[Row], common: Common, history: History, past: times.Times, split: bool) -> list[Planned]:
    """A verdict on each row. One that cannot begin, such as a clip that is not there, is failed and hurts no other."""
    open_, found = opener(common), []
    for row in rows:
        try:
            found.append(verdict(row, open_(row), history, past, split, common.keep))
        except (StageError, OSError) as error:
            found.append(refused(row, error))
    return found


def verdict(
    row: Row, session: Session, history: History, past: times.Times, split: bool, kept: Sequence[str] = ()
) -> Planned:
    """What is left to do for one row, of which results of the stages `kept` stay in the end (all if none is named)."""
    session.pipeline.upstream(kept)  # refuses unknown names
    stages = list(session.pipeline.stages)
    if split:
        session.pipeline.upstream(["train"])  # refuses a pipeline without it
    session.check_sources()
    planned = Planned(row, "todo", stages, stages, megabytes=history.megabytes(row.pipeline))
    if not session.workspace.store.is_dir():  # nothing was ever made, and the clip need not be read
        pass
    elif known := keep.record(session, kept):
        planned.result, planned.todo = known["result"], []
        planned.state = "fresh" if "freed" in planned.result else "todo"
    else:
        verdicts = session.verdicts(stages)
        planned.todo = [name for name, one in verdicts.items() if not one.fresh]
        if not planned.todo:
            stamps = {name: one.made for name, one in verdicts.items()}
            folders = {name: one.folder for name, one in verdicts.items() if one.folder}
            planned.state = "todo" if kept else "fresh"  # the rest is to be let go
            planned.result = result_of(stamps, folders, session.workspace.links)
    ahead = past.forecast(session, planned.todo, first=False)
    planned.expected = {name: guess.seconds for name, guess in ahead.items()}
    return planned


def refused(row: Row, error: Exception) -> Planned:
    """The row of a clip that cannot begin."""
    if isinstance(error, StageError):
        return Planned(row, "failed", problem=error.problem, hint=error.hint, facts=list(error.facts))
    return Planned(row, "failed", problem=f"cannot read it: {error}", hint="put it back, and call the fleet again")


def result_of(stamps: Mapping[str, Stamp], folders: Mapping[str, Path], links: Path) -> dict[str, Any]:
    """What a page shows of a finished row: seconds of all stages, PSNR, effects called for, warnings, pictures."""
    heldout = read_json(folders["evaluate"] / "metrics.json").get("heldout") if "evaluate" in folders else {}
    scores = heldout if isinstance(heldout, dict) else {}
    called = decisions(folders["survey"], "survey") if "survey" in folders else {}
    return {
        "seconds": round(sum(stamp.seconds for stamp in stamps.values()), 1),
        "peak_memory_bytes": max((stamp.peak_memory_bytes for stamp in stamps.values()), default=0),
        "psnr": psnr(scores, "full"),
        "psnr_person": psnr(scores, "person_crop"),
        "effects": [name for name, on in called.items() if on and name != "scene"],
        "warnings": [f"{name}: {text}" for name, stamp in stamps.items() for text in stamp.warnings],
        "picture": picture_of(stamps, folders),
        "pages": [page for page in PAGES if (links / page).is_file()],
    }


def psnr(scores: Mapping[str, Any], region: str) -> float | None:
    """PSNR on held-out frames; None where it was not measured."""
    values = scores.get(region)
    value = values.get("psnr") if isinstance(values, dict) else None
    return round(value, 2) if isinstance(value, float) else None


def picture_of(stamps: Mapping[str, Stamp], folders: Mapping[str, Path]) -> str:
    """A picture of the result, as `evaluate-526d165d/heldout/000019.png` in the store: a held-out frame beside ours, else
    a frame of the clip; '' for none."""
    for stage, room in (("evaluate", "heldout/"), ("frames", "images/")):
        files = sorted(name for name in stamps[stage].files if name.startswith(room)) if stage in stamps else []
        if files:
            return f"{folders[stage].name}/{files[len(files) // 2]}"
    return ""


def as_json(planned: Planned) -> dict[str, Any]:
    """The row of a plan as plain values."""
    row = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(planned.row).items()}
    return {
        "clip": planned.row.name,
        **row,
        "state": planned.state,
        "todo": planned.todo,
        "seconds": planned.seconds,
        "megabytes": planned.megabytes,
        "problem": planned.problem,
        "hint": planned.hint,
    }

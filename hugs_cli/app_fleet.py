"""The command fleet."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from hugs_cli import options, pipelines, times, words
from hugs_cli.console import Console
from hugs_cli.device import device_of
from hugs_cli.options import AsJson, BodyModel, DeviceName, DryRun, PipelineName, PipelinesFile, Settings, Work
from hugs_cli.pipelines import NAME, UsageError

if TYPE_CHECKING:
    from hugs_cli.fleet.plan import Planned


class Split(StrEnum):
    """Where a clip's work is cut into two jobs."""

    train = "train"


def fleet(
    clips: Annotated[
        list[str],
        Argument(help="Clips, patterns, a list (.txt), or a table (.csv, .yaml).", show_default=False),
    ],
    jobs: Annotated[
        int | None,
        Option(min=1, help="Most clips at a time.", show_default="what memory and processors allow"),
    ] = None,
    profile: Annotated[
        str | None, Option(metavar="FOLDER", help="A Snakemake profile, for a cluster; slurm is an example.")
    ] = None,
    split: Annotated[
        Split | None, Option(help="Make two jobs of each clip: stages before training, and the rest.")
    ] = None,
    keep: Annotated[
        str | None, Option(metavar="STAGES", help="Results to keep of a finished clip, such as export,evaluate.")
    ] = None,
    only_failed: Annotated[bool, Option("--only-failed", help="Only the clips that failed in the last call.")] = False,
    name: Annotated[str, Option(help="Name of the page: NAME.html in the work folder.")] = "fleet",
    device: DeviceName = options.Device.auto,
    dry_run: DryRun = False,
    as_json: AsJson = False,
    pipeline: PipelineName = "default",
    set_: Settings = None,
    body_model: BodyModel = None,
    work: Work = Path("work"),
    pipelines_file: PipelinesFile = pipelines.FILE,
) -> None:
    """Run many clips, side by side or on a cluster.

    Fresh results are reused, a clip that fails stops no other, and a second call does the rest.
    The page fleet.html in the work folder shows the progress of each clip.
    """
    from hugs_cli.fleet import board, history, plan, runner
    from hugs_cli.fleet.clips import read
    from hugs_cli.fleet.run import Fleet

    check_asked(name, jobs, profile)
    console, past, kept = Console(), history.history(work), stages_kept(keep)
    pipelines.load(pipeline, set_ or (), pipelines_file).upstream(kept)  # refuses at once what no clip could run with
    common = plan.Common(work, pipelines_file, body_model, device.value, kept)
    rows, known = read(clips, pipeline, set_ or (), work), times.here(device_of(device.value)[0])
    planned = plan.plan(rows, common, past, known, split is not None)
    planned = board.failed_before(planned, work, name) if only_failed else planned
    todo = [one for one in planned if one.state == "todo"]
    at_a_time, why = (jobs or 0, "") if profile else side_by_side(jobs, todo)
    for one in planned:
        one.slowed(runner.slower(at_a_time))
    if dry_run:
        lines = [*map(plan_line, planned), summary(planned, at_a_time)]
        console.result(json.dumps([*map(plan.as_json, planned)], indent=1) if as_json else "\n".join(lines))
        return
    console.say(summary(planned, at_a_time))
    if todo and not profile and (jobs is None or at_a_time < jobs):
        console.say(f"{words.count(at_a_time, 'clip')} at a time: {why}")
    done, total = Fleet(name, common, planned, split is not None, at_a_time, profile).run(console)
    for line in ending(total, kept):
        console.say(line)
    console.result(board.as_json(done, total) if as_json else words.relative(work / f"{name}.html"))
    if not all(row["state"] in board.WELL for row in done):
        raise typer.Exit(1)


def check_asked(name: str, jobs: int | None, profile: str | None) -> None:
    """UsageError for a name that names no fleet, and for what only Snakemake can do where it is not installed."""
    from hugs_cli.fleet import runner

    if not NAME.fullmatch(name):
        raise UsageError(f"{name!r} cannot name a fleet", "use small letters, digits and _")
    if jobs and jobs > 1 and not runner.has_snakemake():
        raise UsageError("clips run side by side only with Snakemake", f"{runner.EXTRA}, or leave out `--jobs`")
    if profile and not runner.has_snakemake():
        raise UsageError("a profile is for Snakemake", f"{runner.EXTRA}, or leave out `--profile`")
    if profile:
        runner.profile_folder(profile)


def stages_kept(keep: str | None) -> tuple[str, ...]:
    """The stages that `--keep` names; UsageError where it is given and names none."""
    kept = tuple(one.strip() for one in (keep or "").split(",") if one.strip())
    if keep is not None and not kept:
        raise UsageError("--keep names no stage", "as `--keep export,evaluate`; without it all results stay")
    return kept


def side_by_side(jobs: int | None, todo: Sequence[Planned]) -> tuple[int, str]:
    """How many clips run at a time on this machine, and why."""
    from hugs_cli.fleet import runner

    if not runner.has_snakemake():
        return 1, f"{runner.EXTRA} lets clips run side by side"
    return runner.side_by_side(jobs, [one.megabytes for one in todo])


def ending(total: dict[str, Any], kept: Sequence[str]) -> list[str]:
    """What a fleet has come to, in lines; of clips that are done the results of the stages `kept` stay."""
    from hugs_cli.fleet.run import counts

    lines = [counts(total), *(f"  {number:>4} x {kind}" for kind, number in total["failures"].items())]
    freed = f"{words.size(total['freed_bytes'])} freed: of clips that are done {', '.join(kept)} stay"
    return lines + ([freed] if total["freed_bytes"] else [])


def plan_line(one: Planned) -> str:
    """A row of the dry run: fresh, or how many stages are left and about how long they take."""
    clip = f"  {words.relative(one.row.root):<32}  {one.row.pipeline:<12}  "
    if one.state == "failed":
        return f"{clip}cannot begin: {one.problem}"
    if one.state == "fresh":
        return f"{clip}fresh" + (f", of {', '.join(kept)} alone" if (kept := one.result.get("kept")) else "")
    if not one.todo:
        return f"{clip}made; results that are not kept go now"
    return f"{clip}{words.count(len(one.todo), 'stage')} to do, about {words.duration(one.seconds)}"


def summary(planned: Sequence[Planned], at_a_time: int) -> str:
    """All rows in a line."""
    states = Counter(one.state for one in planned)
    said = [f"{words.count(len(planned), 'clip')}: {states['fresh']} fresh, {states['todo']} to do"]
    said += [f"{states['failed']} cannot begin"] if states["failed"] else []
    if states["todo"]:
        seconds = sum(one.seconds for one in planned) / max(1, at_a_time)
        said.append(f"about {words.duration(seconds)}" + ("" if at_a_time else " of machine time"))
    return ", ".join(said)

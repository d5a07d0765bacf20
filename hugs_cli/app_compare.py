"""The commands that compare results of one clip: ablate, costs."""

from __future__ import annotations

import json
from typing import Annotated

from typer import Option

from hugs_cli import options, words
from hugs_cli.console import Console
from hugs_cli.options import AsJson, DeviceName, DryRun, RunOptions, on_a_run
from hugs_cli.pipelines import UsageError


@on_a_run
def ablate(
    video: options.Video,
    given: RunOptions,
    part: Annotated[
        list[str] | None, Option(help="Leave out only this part (may be repeated); none: the pipeline alone.")
    ] = None,
    seeds: Annotated[int, Option(min=1, help="Seeds per variant, starting at --seed.")] = 3,
    device: DeviceName = options.Device.auto,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Measure what each part of the method is worth.

    Trains the pipeline, and five variants of it with one part left out each.
    """
    console = Console()
    session = given.of_last_run(video, console).session(video)
    from hugs_cli.studies import ablate as ablations

    cases = ablations.cases(session, part or (), seeds)
    for lacked in (one for one in ablations.lacking(session) if not part or one in part):
        console.say(f"{lacked} is left out: pipeline {session.pipeline.name} does not have that part")
    session.check_sources()
    if not dry_run:
        session.workspace.create()
    plan = ablations.plan(cases)
    if dry_run:
        rows = [{"pipeline": one.session.pipeline.name, "seed": one.seed, "train": state} for one, state, _ in plan]
        lines = [f"  {row['pipeline']:<24}seed {row['seed']:<4}{row['train']}" for row in rows]
        console.result(json.dumps(rows, indent=1) if as_json else "\n".join([ablations.summary(plan, device), *lines]))
        return
    console.say(ablations.summary(plan, device))
    result = {"clip": session.video.name, **ablations.run(cases, device.value, console)}
    console.result(json.dumps(result, indent=1) if as_json else "\n".join(ablations.table(result)))


@on_a_run
def costs(
    video: options.Video,
    given: RunOptions,
    sweep: Annotated[bool, Option("--sweep", help="Vary one setting at a time, and train.")] = False,
    axis: Annotated[list[str] | None, Option(help="Vary only this axis (may be repeated; with --sweep).")] = None,
    seeds: Annotated[int, Option(min=1, help="Seeds per case, starting at --seed (with --sweep).")] = 3,
    budget: Annotated[float, Option(min=0, help="Minutes to train; 0: only cached results (with --sweep).")] = 120,
    plot: Annotated[bool, Option("--plot", help="Also write a plot and a page beside the results.")] = False,
    device: DeviceName = options.Device.auto,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Compare time and accuracy of pipelines or settings.

    Without --sweep: the pipelines that were run on a clip. With it: one setting at a time is varied, and trained.
    """
    console = Console()
    session = given.of_last_run(video, console).session(video)
    from hugs_cli.studies import costs as accounts

    clip, root = session.video.name, session.workspace.root
    if axis and not sweep:
        raise UsageError("only a sweep has axes", "add `--sweep`")
    if sweep:
        from hugs_cli.studies import sweep as sweeps

        cases = sweeps.sweep(session, axis or (), seeds)
        session.check_sources()
        plan = sweeps.plan(cases, 60 * budget)
        if dry_run:
            rows = [{"pipeline": c.session.pipeline.name, "seed": c.seed, "state": s, "seconds": t} for c, s, t in plan]
            lines = [sweeps.summary(cases, plan, 60 * budget, device), *sweeps.plan_lines(plan)]
            console.result(json.dumps(rows, indent=1) if as_json else "\n".join(lines))
            return
        session.workspace.create()
        console.say(sweeps.summary(cases, plan, 60 * budget, device))
        result = sweeps.run(cases, 60 * budget, device.value, console)
    else:
        result = accounts.compared(accounts.runs(session.workspace))
    result = {"clip": clip, **result}
    if plot:
        name, title = (
            ("sweep-" + session.pipeline.name, f"around {session.pipeline.name}") if sweep else ("costs", "costs")
        )
        console.say(words.relative(accounts.write_page(root, name, f"{clip}: {title}", result)))
    console.result(json.dumps(result, indent=1) if as_json else "\n".join(accounts.table(result)))

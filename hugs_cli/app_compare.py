"""The commands that set results of one clip beside each other: ablate, costs."""

from __future__ import annotations

import json
from typing import Annotated

from typer import Option

from hugs_cli import options, words
from hugs_cli.cache.freshness import Judge
from hugs_cli.console import Console
from hugs_cli.options import AsJson, DeviceName, DryRun, on_clip
from hugs_cli.pipelines import UsageError


@on_clip
def ablate(
    judge: Judge,
    part: Annotated[
        list[str] | None, Option(help="Only without this part (may be repeated); none: the pipeline alone.")
    ] = None,
    seeds: Annotated[int, Option(min=1, help="Trainings of each, from --seed on; what lies before is shared.")] = 3,
    device: DeviceName = options.Device.cpu,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """What each part of the method is worth on this clip: the pipeline, and five times the same without one part."""
    from hugs_cli.studies import ablate as ablations

    console, cases = Console(), ablations.cases(judge, part or (), seeds)
    judge.check_sources()
    if not dry_run:
        judge.workspace.create()
    plan = ablations.plan(cases)
    if dry_run:
        rows = [{"pipeline": one.judge.pipeline.name, "seed": one.seed, "train": state} for one, state, _ in plan]
        lines = [f"  {row['pipeline']:<24}seed {row['seed']:<4}{row['train']}" for row in rows]
        console.result(json.dumps(rows, indent=1) if as_json else "\n".join([ablations.announced(plan), *lines]))
        return
    console.say(ablations.announced(plan))
    result = {"clip": judge.sources["video"].name, **ablations.run(cases, device.value, console)}
    console.result(json.dumps(result, indent=1) if as_json else "\n".join(ablations.table(result)))


@on_clip
def costs(
    judge: Judge,
    sweep: Annotated[bool, Option("--sweep", help="Vary one axis at a time around the pipeline, and train.")] = False,
    axis: Annotated[list[str] | None, Option(help="Only this axis of a sweep (may be repeated).")] = None,
    seeds: Annotated[int, Option(min=1, help="Of a sweep: trainings of each case, from --seed on.")] = 3,
    budget: Annotated[float, Option(min=0, help="Of a sweep: minutes to train; 0: only what is cached.")] = 120,
    plot: Annotated[bool, Option("--plot", help="Draw it, too: SVG, PNG and a page beside the results.")] = False,
    device: DeviceName = options.Device.cpu,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """What the pipelines that were run on a clip cost, and what that bought; --sweep: what each setting costs and buys."""
    from hugs_cli.studies import costs as accounts

    console, clip, root = Console(), judge.sources["video"].name, judge.workspace.root
    if axis and not sweep:
        raise UsageError("only a sweep has axes", "add `--sweep`")
    if sweep:
        from hugs_cli.studies import sweep as sweeps

        cases = sweeps.sweep(judge, axis or (), seeds)
        judge.check_sources()
        plan = sweeps.plan(cases, 60 * budget)
        if dry_run:
            rows = [{"pipeline": c.judge.pipeline.name, "seed": c.seed, "state": s, "seconds": t} for c, s, t in plan]
            lines = [sweeps.announced(cases, plan, 60 * budget), *sweeps.listed(plan)]
            console.result(json.dumps(rows, indent=1) if as_json else "\n".join(lines))
            return
        judge.workspace.create()
        console.say(sweeps.announced(cases, plan, 60 * budget))
        result = sweeps.run(cases, 60 * budget, device.value, console)
    else:
        result = accounts.compared(accounts.runs(judge.workspace))
    result = {"clip": clip, **result}
    if plot:
        from hugs_cli.studies import costs_page

        name, title = ("sweep-" + judge.pipeline.name, f"around {judge.pipeline.name}") if sweep else ("costs", "costs")
        console.say(words.relative(costs_page.write(root, name, f"{clip}: {title}", result)))
    console.result(json.dumps(result, indent=1) if as_json else "\n".join(accounts.table(result)))

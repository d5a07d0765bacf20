"""Wrong at once: before the first stage runs, all that will run look at their settings and at the files that the user gave."""

from __future__ import annotations

from collections.abc import Iterable

from hugs_cli.cache.freshness import Session
from hugs_cli.cache.launcher import Launcher
from hugs_cli.direct import failed
from hugs_cli.pipelines import Stage
from stages.contract import keywords, load_stage


def check(session: Session, stages: Iterable[Stage], launcher: Launcher) -> None:
    """Let these stages check what they are given, in the process that will run the first of them; StageFailed by the first
    that refuses it."""
    jobs = []
    for stage in stages:
        if own := load_stage(stage.module).check:
            given = {name: session.sources.get(name) for name in keywords(own)}
            inputs = {name: str(path.absolute()) if path else None for name, path in given.items()}
            params = stage.params.model_dump(mode="json")
            jobs.append({"stage": stage.name, "module": stage.module, "params": params, "inputs": inputs})
    if jobs and (event := launcher.check(jobs)):
        raise failed(event, f"the check of stage {event['stage']}", "what stands above")
